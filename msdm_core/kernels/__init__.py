"""Compiled functions of the organ's substep, alone and in lanes."""
