"""Pictures of a simulation: colour, depth and labels of each pixel, off screen or in a window."""
