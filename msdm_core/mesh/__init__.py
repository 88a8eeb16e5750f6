"""Tetrahedral meshes and triangle surfaces: structure, quality, order, distances along the surface."""
