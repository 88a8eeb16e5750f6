"""Recorded presses on tissue, and the material of this organ that describes them: `surgsim identify`."""
