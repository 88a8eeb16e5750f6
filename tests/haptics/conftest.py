"""A UDP device, its clock and a bridge that talks to it."""

import pytest

from surgsim_apps.haptics.udp import UdpDevice
from tests.haptics.udp_link import Clock, Sender


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def device(clock):
    made = UdpDevice(clock=clock)
    yield made
    made.close()


@pytest.fixture
def sender(device):
    made = Sender(device)
    yield made
    made.socket.close()
