"""Validation of the tissue against independent references, case by case: `surgsim validate`."""
