"""surgsim_env: soft organs and robotic instruments as Gymnasium environments; importing it registers their ids."""

from surgsim_env.env import register
from surgsim_env.scenes import list_scenes, make_scene

__all__ = ["list_scenes", "make_scene", "register"]

register()
