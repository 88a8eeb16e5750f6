"""Organs on a CUDA device; needs the `cuda` extra."""
