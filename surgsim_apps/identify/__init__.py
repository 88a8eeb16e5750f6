"""Identification of materials from recorded presses on tissue: `surgsim identify`."""
