"""Pictures of a simulation: colour, depth and labels, off screen or in a window."""

from surgsim_env.rendering import gl
from surgsim_env.rendering.cameras import Camera, scene_cameras
from surgsim_env.rendering.embedding import organ_surface
from surgsim_env.rendering.gl import NoGLError
from surgsim_env.rendering.looks import LOOK_SPLITS, draw_look, find_look_ranges, look_generator
from surgsim_env.rendering.options import CAMERAS, RenderOptions
from surgsim_env.rendering.painted_fields import COLOUR_MAP, PAINTED_FIELDS, PaintedField, field_colours
from surgsim_env.rendering.renderer import OrganRenderer, draw_arm_still
from surgsim_env.rendering.scene_model import geom_colour, is_support, mesh_rows, shown_geoms
from surgsim_env.rendering.surface import BEND, smooth_normals
from surgsim_env.rendering.tissue import clip_triangles, cut_edges, lesion_ball

__all__ = [
    "BEND",
    "CAMERAS",
    "COLOUR_MAP",
    "LOOK_SPLITS",
    "PAINTED_FIELDS",
    "Camera",
    "NoGLError",
    "OrganRenderer",
    "PaintedField",
    "RenderOptions",
    "clip_triangles",
    "cut_edges",
    "draw_arm_still",
    "draw_look",
    "field_colours",
    "find_look_ranges",
    "geom_colour",
    "gl",
    "is_support",
    "lesion_ball",
    "look_generator",
    "mesh_rows",
    "organ_surface",
    "scene_cameras",
    "shown_geoms",
    "smooth_normals",
]
