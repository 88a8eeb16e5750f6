"""Haptic devices on a live simulation: a pose in, a force out, once a haptic step; `docs/haptics.md` has it whole."""
