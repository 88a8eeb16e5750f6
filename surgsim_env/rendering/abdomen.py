"""Abdomen around an organ in endoscopic pictures: a floor of fat, loops of bowel behind the organ, and a wall."""

import numpy as np
from scipy.spatial import KDTree

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.rendering.cameras import scene_cameras
from surgsim_env.rendering.surface import Shape, smooth_normals
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.palpable_surface import tangent_axes

# Vertices of the floor from its middle to the wall, of the wall up to the dome's top, and around.
FLOOR_RINGS, WALL_RINGS, SECTORS = 72, 12, 128
# Vertices of the abdomen's mesh and its triangles.
VERTEX_COUNT = (FLOOR_RINGS + WALL_RINGS) * SECTORS
FACE_COUNT = 2 * (FLOOR_RINGS + WALL_RINGS - 1) * SECTORS
# Distances in radii of the organ: the floor's waves and their depth, loops of bowel from the organ's middle, half their
# width, their height over half their width.
WAVE, WAVE_DEPTH = 0.9, 0.05
LOOPS, LOOP_WIDTH, LOOP_HEIGHT = (1.75, 2.5, 3.25), 0.36, 1.1
# Distance at which fat has passed into the wall's peritoneum, in radii.
FAT_END = 3.8
# Width of the shadow around the organ's contact, in radii.
SHADE_WIDTH = 0.16
# Distance of the wall, in distances of the farthest camera.
WALL = 1.3


def abdomen(anatomy: Anatomy, ground: FloatArray) -> Shape:
    """Inner surface of an abdomen around an organ; `ground` is a point of the floor below the organ [m].

    In place of resting places the vertices have the shares of fat and of bowel, and their light, 0 to 1.
    """
    points, up = anatomy.mesh.points, -anatomy.downward
    across, along = tangent_axes(anatomy.downward)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    axes = np.column_stack([across, along, up])
    flat = (points - middle) @ axes[:, :2]
    radius = float(np.linalg.norm(flat, axis=1).max())
    reach = WALL * max(float(np.linalg.norm(c.position - middle)) for c in scene_cameras(anatomy).values()) / radius
    reach = max(reach, LOOPS[-1] + 1.0)
    # From here on lengths are in radii of the organ. Rings are denser near it.
    angle = np.linspace(0.0, 2.0 * np.pi, SECTORS, endpoint=False)
    rise = np.linspace(0.0, 0.5 * np.pi, WALL_RINGS + 1)[1:]
    inner = np.linspace(0.0, 1.0, FLOOR_RINGS)
    ring = np.concatenate([reach * (0.75 * inner + 0.25 * inner**3), reach * np.cos(rise)])[:, None]
    height = np.concatenate([np.zeros(FLOOR_RINGS), 0.9 * reach * np.sin(rise)])[:, None] + 0.0 * angle
    x, y = ring * np.cos(angle), ring * np.sin(angle)
    is_floor = (np.arange(len(ring)) < FLOOR_RINGS)[:, None]
    # Cameras stand on the other side: overview, endoscope and side see the loops behind the organ.
    behind = np.clip(0.5 + 1.2 * np.cos(angle - 0.75 * np.pi), 0.0, 1.0)
    bowel = np.zeros_like(height)
    for number, place in enumerate(LOOPS):
        path = place + 0.12 * np.sin(5.0 * angle + 2.0 * number) + 0.09 * np.sin(11.0 * angle + number)
        # Haustra: the loop is narrower every few widths.
        wide = LOOP_WIDTH * (1.0 + 0.09 * np.cos(26.0 * angle + 3.0 * np.sin(3.0 * angle + number))) * behind
        share = (ring - path) / np.maximum(wide, 1e-6)
        tube = LOOP_HEIGHT * wide * np.sqrt(np.clip(1.0 - share**2, 0.0, 1.0))
        bowel = np.maximum(bowel, np.where(is_floor, tube, 0.0))
    waves = np.sin(2.0 * np.pi * x / WAVE + 1.0) * np.sin(2.0 * np.pi * y / WAVE) - 1.0
    height = height + np.where(is_floor, np.maximum(WAVE_DEPTH * waves, bowel), 0.0)
    vertices = ground + radius * np.stack([x, y, height], axis=-1).reshape(-1, 3) @ axes.T
    vertices += axes[:, :2] @ ((middle - ground) @ axes[:, :2])
    row, column = np.meshgrid(np.arange(len(ring) - 1), np.arange(SECTORS), indexing="ij")
    first, second = row * SECTORS + column, row * SECTORS + (column + 1) % SECTORS
    near = np.stack([first, first + SECTORS, second + SECTORS], axis=-1).reshape(-1, 3)
    far = np.stack([first, second + SECTORS, second], axis=-1).reshape(-1, 3)
    faces = np.concatenate([near, far]).astype(np.int32)
    gap, _ = KDTree(points[anatomy.mesh.boundary_nodes]).query(vertices)
    light = 1.0 - np.exp(-gap / (SHADE_WIDTH * radius))
    is_bowel = np.clip(12.0 * bowel, 0.0, 1.0)
    fat = (1.0 - is_bowel) * np.clip(FAT_END - ring, 0.0, 1.0) * is_floor
    kinds = np.stack([fat, is_bowel, light.reshape(fat.shape)], axis=-1)
    return Shape(vertices, smooth_normals(vertices, faces), faces, rest=kinds.reshape(-1, 3))
