"""Applications of surgsim_env, a folder each: each imports only names that the engine exports."""

import surgsim_env  # noqa: F401  (loads MuJoCo, whatever MUJOCO_GL says)
