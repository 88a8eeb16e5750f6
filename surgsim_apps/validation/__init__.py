"""`surgsim validate`: how far the tissue is from the solid asked for, case by case, against independent references."""
