"""Compiling an organ, its supports, its stable step, and advancing it."""
