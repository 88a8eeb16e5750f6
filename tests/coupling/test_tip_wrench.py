"""The wrench on the tip of one arm and of two."""

import gymnasium as gym
import numpy as np

import surgsim_env  # noqa: F401
from surgsim_env.coupling.tip_forces import tip_wrench
from surgsim_env.scripting import oracle_script, run_script


class Reader(gym.Wrapper):
    """Reads the wrench after each step, here and by the levers of MuJoCo's bodies."""

    def __init__(self, env):
        super().__init__(env)
        self.wrenches = []

    def step(self, action):
        result = self.env.step(action)
        simulation = self.env.unwrapped.simulation
        instrument = simulation.instrument
        force, torque = np.zeros(3), np.zeros(3)
        for name, wrench in zip(instrument.tool_names, simulation.contact_wrench, strict=True):
            centre = instrument.data.body(name).xipos
            force += wrench[:3]
            torque += wrench[3:] + np.cross(centre - instrument.tip_position, wrench[:3])
        self.wrenches.append((tip_wrench(simulation), np.concatenate([force, torque])))
        return result


def test_the_torque_is_about_the_tip():
    """T = sum_i (T_i + (c_i - tip) x F_i), while a jaw grasps and folds a lobe."""
    env = Reader(gym.make("SurgSim/Retract-v0"))
    env.reset(seed=0)
    run_script(env, oracle_script(env))
    wrenches, wanted = (np.array(part) for part in zip(*env.wrenches))
    assert np.abs(wanted[:, 3:]).max() > 1e-3
    np.testing.assert_allclose(wrenches[:, :3], wanted[:, :3], rtol=1e-5, atol=1e-7)
    # Levers are of the start of the last haptic step of 1 ms: the tip moves at up to 0.05 m/s.
    slack = 0.05 * 0.001 * np.linalg.norm(wanted[:, :3], axis=1)
    assert (np.abs(wrenches[:, 3:] - wanted[:, 3:]).max(axis=1) <= 2.0 * slack + 1e-7).all()


def test_two_arms_have_two_wrenches():
    env = gym.make("SurgSim/BimanualRetract-v0")
    env.reset(seed=0)
    assert tip_wrench(env.unwrapped.simulation).shape == (12,)
