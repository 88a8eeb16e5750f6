"""Steps of retraction's environment, and grasps that tests tell its task of."""

import numpy as np

from surgsim_env.instruments.instrument import Grasp

STEP = 0.05
HELD = Grasp(opening=0.01, grip_force=0.4, pull_force=0.1, friction_left=0.2, holds=True)
EMPTY = Grasp(opening=0.02, grip_force=0.0, pull_force=0.0, friction_left=0.0, holds=False)


def act(env, velocity=(0.0, 0.0, 0.0), jaw=None, turning=None):
    return env.step(env.layout.action(np.array(velocity), jaw=jaw, turning=turning).astype(np.float32))
