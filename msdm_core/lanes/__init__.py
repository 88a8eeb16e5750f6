"""Many organs advanced side by side in vector registers."""
