"""From a patient's scan, or surfaces drawn from one, to a scene: labels, mesh, materials, report."""
