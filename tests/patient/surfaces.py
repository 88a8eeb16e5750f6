"""Surfaces that tests make."""

from pathlib import Path

import numpy as np
import trimesh


def ball(path: Path, radius: float = 30.0, place=(0.0, 0.0, 0.0), drop: int = 0) -> Path:
    """A ball's surface [mm] as a file, some of its triangles missing."""
    mesh = trimesh.creation.icosphere(3, radius)
    trimesh.Trimesh(mesh.vertices + np.array(place), mesh.faces[drop:], process=False).export(path)
    return path
