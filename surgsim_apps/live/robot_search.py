"""A search on the live page that presses by itself: GP-UCB on a session's organ."""

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_apps.live.session import Session
from surgsim_env.coupling import Simulation
from surgsim_env.palpation import LesionEstimator, press
from surgsim_env.scene import tangent_axes

# Presses of a search, and factor on the deviation in GP-UCB.
PRESSES, UCB_BETA = 12, 3.0
# Distance between the sites, in tip radii; share of the press depth from which a press holds, for a time [s].
SITE_SPACING, HOLD_SHARE, HOLD = 0.4, 0.8, 0.15
# A press that does not come to hold ends after [s].
PRESS_LONGEST = 3.0
# Standard deviation of a log contrast about the healthy organ's.
NOISE = 0.04


class RobotSearch:
    """Presses at the largest mean + UCB_BETA x deviation of the excess (GP-UCB, Srinivas et al. 2010).

    The contrast of a press is over the healthy organ's, which a simulation without pace presses at the same place.

    Fields:
        presses: so far
        force_peak: of them [N]
        place: of the lesion on the surface [m], (3,); None before the end
    """

    def __init__(self, session: Session) -> None:
        """Take a session; `go_on` begins."""
        self._session, anatomy = session, session.anatomy
        self._face, scene = anatomy.face, anatomy.scene
        self._depth = scene.palpation.press_depth
        self._points, self._normals = anatomy.face.raster(SITE_SPACING * scene.instrument.tip_radius)
        on_plane = self._points @ np.stack(tangent_axes(anatomy.face.approach), axis=1)
        self._sites = on_plane - on_plane.min(axis=0)
        assert scene.lesion is not None
        self._estimator = LesionEstimator(
            self._sites.max(axis=0), lesion_radius=float(np.mean(scene.lesion.radius)), noise=NOISE
        )
        self.presses, self.force_peak = 0, 0.0
        self.place: FloatArray | None = None
        self._readings: list[tuple[float, float, float]] = []
        self._steps = self._search()

    def feel(self, moment: float, depth: float, force: float) -> None:
        """Take a reading: time [s], depth of the tip [m], the force's size [N]."""
        self.force_peak = max(self.force_peak, force)
        self._readings.append((moment, depth, force))

    def go_on(self) -> bool:
        """Go on with what was felt since; False after the last press."""
        return next(self._steps, None) is not None

    @cached_property
    def _healthy(self) -> Simulation:
        anatomy = self._session.anatomy
        scene = replace(anatomy.scene, instrument=replace(anatomy.scene.instrument, model="probe.xml"), motions=())
        simulation = Simulation(replace(anatomy, scene=scene))
        simulation.reset(anatomy.organ(), self._points[0] + 2.0 * scene.instrument.tip_radius * self._normals[0])
        return simulation

    def _healthy_press(self, site: int) -> tuple[float, float]:
        pressed = press(self._healthy, self._points[site], self._normals[site])
        return pressed.depth, pressed.force

    def _search(self) -> Iterator[bool]:
        pressed: list[int] = []
        values: list[float] = []
        with ThreadPoolExecutor(1, "surgsim robot") as worker:
            while self.presses < PRESSES:
                site = self._best(pressed, values)
                healthy = worker.submit(self._healthy_press, site)
                self._readings.clear()
                self._session.touch(0, self._points[site], self._normals[site], self._depth)
                while not self._holds():
                    yield True
                _, depth, force = self._readings[-1]
                self._session.lift(0)
                while self._session.touches(0) or not healthy.done():
                    yield True
                self.presses += 1
                depth_healthy, force_healthy = healthy.result()
                pressed.append(site)
                # Hertz (1881): force grows with depth^1.5.
                share = max(force, 1e-6) / force_healthy * (depth_healthy / max(depth, 1e-6)) ** 1.5
                values.append(math.log(share))
        estimate = self._estimator.estimate(self._sites[pressed], values)
        row, column = np.unravel_index(np.argmax(estimate.excess), estimate.excess.shape)
        highest = [estimate.axes[0][column], estimate.axes[1][row]]
        place = estimate.points[0] if len(estimate.points) else np.array(highest)
        self.place = self._points[np.argmin(np.square(self._sites - place).sum(axis=1))]

    def _holds(self) -> bool:
        """True once the press was at depth for HOLD, or has taken too long."""
        if not self._readings:
            return False
        now, begun = self._readings[-1][0], self._readings[0][0]
        deep = next((moment for moment, depth, _ in self._readings if depth >= HOLD_SHARE * self._depth), now)
        return now - deep >= HOLD or now - begun >= PRESS_LONGEST

    def _best(self, pressed: list[int], values: list[float]) -> int:
        """The fresh site of the largest upper confidence bound; the first is in the middle."""
        places = self._sites[pressed]
        if not pressed:
            return int(np.square(self._sites - self._sites.mean(axis=0)).sum(axis=1).argmin())
        _, excess = self._estimator.process.mean(places, np.array(values))
        bound = excess + UCB_BETA * self._estimator.process.spread(places)
        columns, rows = (
            np.abs(axis[:, None] - self._sites[:, side]).argmin(axis=0)
            for side, axis in enumerate(self._estimator.axes)
        )
        worth = bound[rows, columns]
        worth[pressed] = -np.inf
        return int(np.argmax(worth))
