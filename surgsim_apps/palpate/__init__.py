"""Palpation of a whole organ by scripted presses: sites, contrast maps, lesions and figures of `surgsim palpate`."""
