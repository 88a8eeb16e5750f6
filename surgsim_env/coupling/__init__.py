"""The force exchange between organ and instrument, the simulation that steps both, and groups of lanes."""
