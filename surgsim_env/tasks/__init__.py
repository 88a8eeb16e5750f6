"""Tasks: they draw an episode, read the simulation and judge it; they never advance it."""
