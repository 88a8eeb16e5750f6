"""Free motion of an organ, computed by the kernels; frequency and decay rate of a signal."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import curve_fit

from msdm_core.kernels.structure_kernels import FAULT_NONE, OrganModel, OrganState
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.organ.compile import rest_state
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance_organ, describe_fault

SAMPLES = 400


def released(
    model: OrganModel, displacement: FloatArray, duration: float, *, step_share: float = 0.5
) -> tuple[FloatArray, FloatArray]:
    """Release an organ from a small displacement and follow its part along that shape, u0 . M u(t).

    Args:
        model: the organ.
        displacement: the shape it is released from [m], shape (n_node, 3).
        duration: [s].
        step_share: of the organ's stable step.

    Returns:
        times [s] and the part, 1 at the start, both (SAMPLES + 1,).
    """
    weight = displacement * model.node_mass[:, None]
    weight /= float((weight * displacement).sum())

    def part(state: OrganState) -> float:
        return float((weight * (state.node_position - model.node_rest_position)).sum())

    state = rest_state(model)
    state.node_position[:] += displacement
    every = max(1, round(duration / SAMPLES / (step_share * model.stable_step)))
    dt = duration / SAMPLES / every
    return dt * every * np.arange(SAMPLES + 1, dtype=np.float64), followed(model, state, dt, every, SAMPLES, part)


def followed(
    model: OrganModel,
    state: OrganState,
    dt: float,
    every: int,
    count: int,
    measure: Callable[[OrganState], float],
) -> FloatArray:
    """A measure of the state at the start and after each of `count` runs of `every` steps of dt [s]."""
    wrench = np.zeros((0, 6))
    values = [measure(state)]
    for _ in range(count):
        fault = advance_organ(model, state, NO_SHAPES, NO_CONTACT, dt, every, wrench)
        if fault != FAULT_NONE:
            raise ValueError(describe_fault(model, state, fault))
        values.append(measure(state))
    return np.array(values)


def fitted_oscillation(time: FloatArray, value: FloatArray) -> tuple[float, float]:
    """Frequency [Hz] and rate of decay [1/s] of A exp(-d t) cos(2 pi f t + p), by least squares."""
    place = np.flatnonzero(np.diff(np.sign(value)) != 0)
    start = (len(place) - 1) / (2.0 * (time[place[-1]] - time[place[0]]))

    def damped(t: FloatArray, size: float, frequency: float, rate: float, phase: float) -> FloatArray:
        return size * np.exp(-rate * t) * np.cos(2.0 * np.pi * frequency * t + phase)

    found, _ = curve_fit(damped, time, value, p0=(value[0], start, 0.0, 0.0))
    return float(found[1]), float(found[2])
