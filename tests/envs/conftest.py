"""Environments of retraction that a module's tests share."""

import pytest

from surgsim_env.envs.ids import RetractEnv


@pytest.fixture(scope="module")
def shared_retract():
    """One environment for tests that leave nothing behind but an episode."""
    return RetractEnv(scaled=False)


@pytest.fixture
def retract_env(shared_retract):
    shared_retract.reset(seed=1)
    return shared_retract
