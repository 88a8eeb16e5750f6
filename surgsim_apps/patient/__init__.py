"""A patient's scan, or surfaces segmented from one, made into a scene: labels, mesh, materials, report."""
