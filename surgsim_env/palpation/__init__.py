"""Presses, contrast maps, lesion estimators and scores of palpation; `surgsim palpate`."""
