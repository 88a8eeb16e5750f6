"""Displacement of an organ's surface with its ground, seen by a camera's markers and extrapolated."""

import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.simulation import Simulation

# A picture is evaluated this long after it was taken, and its markers' speed is read over as long [s]; chosen: two
# pictures of an endoscope with 60 a second.
FRAME_DELAY = 1.0 / 30.0


class SurfaceTracker:
    """Median displacement of markers on an organ's surface, extrapolated at constant velocity from a camera's pictures.

    The median hardly changes where a tool presses some of the markers. What moves a part of the organ alone, as a
    heartbeat does, is seen as far as it moves half of the markers.
    """

    def __init__(self, simulation: Simulation, markers: NDArray[np.integer]) -> None:
        """Watch some nodes (n_marker,) of the present organ, as if it had moved at its velocity for some pictures."""
        self._simulation, self._markers = simulation, markers
        self._rest = simulation.rest_position[markers]
        state = simulation.organ_state
        now, place = simulation.time, self._seen()
        velocity = np.median(state.node_velocity[markers], axis=0)
        self._times = [now - 2.0 * FRAME_DELAY, now - FRAME_DELAY, now]
        self._places = [place + (time - now) * velocity for time in self._times]

    def look(self) -> None:
        """Take a picture."""
        self._times.append(self._simulation.time)
        self._places.append(self._seen())

    def displacement(self, ahead: float = 0.0) -> FloatArray:
        """The surface's displacement from rest [m] (3,), expected in `ahead` seconds."""
        now = self._simulation.time
        last = self._before(now - FRAME_DELAY)
        first = self._before(self._times[last] - FRAME_DELAY)
        velocity = (self._places[last] - self._places[first]) / (self._times[last] - self._times[first])
        return self._places[last] + (now + ahead - self._times[last]) * velocity

    def _seen(self) -> FloatArray:
        return np.median(self._simulation.organ_state.node_position[self._markers] - self._rest, axis=0)

    def _before(self, time: float) -> int:
        """Index of the last picture taken by a time [s]."""
        # Times are sums of haptic steps.
        return int(np.searchsorted(self._times, time + 1e-9, side="right")) - 1
