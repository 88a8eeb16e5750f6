"""Stiffness limit of a coupling: its inequality, its known special cases, and what is refused."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgsim_apps.haptics.coupling import TipDynamics, VirtualCoupling, check_coupling, coupling_for, stiffness_limit
from surgsim_apps.haptics.device import DeviceDynamics

DT = 1e-3
TIP = TipDynamics(mass=0.14, damping=2.0)
positive = st.floats(0.01, 20.0)
lags = st.floats(0.0, 0.01)


def margin(stiffness, device, tip, damping):
    """Least eigenvalue of diag(b_d, b_t) - S (1 1; 1 1) - D (1 1/2; 1/2 0): what is left of the energy taken a step."""
    shared, late = stiffness * DT / 2 + damping, stiffness * device.delay
    taken = np.diag([device.damping, tip.damping])
    given_back = shared * np.ones((2, 2)) + late * np.array([[1.0, 0.5], [0.5, 0.0]])
    return np.linalg.eigvalsh(taken - given_back)[0]


@settings(deadline=None)
@given(positive, positive, st.floats(0.0, 0.9), lags)
def test_limit_is_where_the_energy_taken_ends(mine, other, share, lag):
    """Independent of the closed form: just below the limit the quadratic form is positive, just above it is not."""
    device, tip = DeviceDynamics(mine, 0.05, lag), TipDynamics(0.14, other)
    damping = share * mine * other / (mine + other)
    limit = stiffness_limit(device, tip, damping, DT)
    assert limit > 0.0
    assert margin(0.999 * limit, device, tip, damping) > 0.0 > margin(1.001 * limit, device, tip, damping)


@settings(deadline=None)
@given(positive, st.floats(0.0, 0.9), lags)
def test_tip_that_stands_still_gives_the_limit_of_colgate_and_schenkel(mine, share, lag):
    """K <= 2 (b - |B|) / (T + 2 L): Colgate & Schenkel 1997 for L = 0; a sample of lag costs K T of damping."""
    device = DeviceDynamics(mine, 0.05, lag)
    limit = stiffness_limit(device, TipDynamics(1.0, 1e9), share * mine, DT)
    assert limit == pytest.approx(2.0 * (mine - share * mine) / (DT + 2.0 * lag), rel=1e-6)


def test_no_coupling_where_its_damper_alone_is_too_much():
    assert stiffness_limit(DeviceDynamics(0.5, 0.05), TIP, 0.4, DT) == 0.0  # 0.5 * 2 / 2.5


def test_rarer_poses_and_delay_cost_stiffness():
    limits = [
        stiffness_limit(device, TIP, 0.0, DT)
        for device in (
            DeviceDynamics(0.5, 0.05),
            DeviceDynamics(0.5, 0.05, delay=1e-3),
            DeviceDynamics(0.5, 0.05, delay=1e-3),
            DeviceDynamics(0.5, 0.05, delay=2e-3),
        )
    ]
    assert limits[0] == pytest.approx(800.0)  # (2 / T) b_d b_t / (b_d + b_t)
    assert limits[1] == limits[2]
    assert limits[0] > limits[1] > limits[3]


@settings(deadline=None)
@given(st.floats(0.05, 5.0), lags)
def test_chosen_coupling_is_borne(mine, lag):
    device = DeviceDynamics(mine, 0.05, lag)
    coupling = coupling_for(device, TIP, DT)
    check_coupling(coupling, device, TIP, DT)
    assert coupling.damping > 0.0


def test_chosen_coupling_without_a_device_that_pushes_damps_the_tip():
    coupling = coupling_for(None, TIP, DT)
    assert coupling.stiffness == 500.0
    # Critical: B = 2 sqrt(K m).
    assert coupling.damping == pytest.approx(2.0 * math.sqrt(500.0 * 0.14))
    check_coupling(coupling, None, TIP, DT)


def test_coupling_stiffer_than_the_limit_is_refused_with_the_limit():
    device = DeviceDynamics(0.5, 0.05)
    check_coupling(VirtualCoupling(799.9), device, TIP, DT)
    with pytest.raises(ValueError, match=r"801 N/m.* 800 N/m"):
        check_coupling(VirtualCoupling(801.0), device, TIP, DT)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: VirtualCoupling(math.nan), "stiffness is nan"),
        (lambda: VirtualCoupling(100.0, -1.0), "damping is -1"),
        (lambda: DeviceDynamics(0.0, 0.05), "damping is 0"),
        (lambda: DeviceDynamics(0.5, 0.05, delay=-1e-3), "delay is -0.001"),
    ],
)
def test_bad_numbers_are_refused(make, named):
    with pytest.raises(ValueError, match=named):
        make()
