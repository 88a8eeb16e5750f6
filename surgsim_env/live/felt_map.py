"""Stiffness map of the organ's surface from the tips' contact forces."""

import numpy as np
from scipy.spatial import KDTree

from msdm_core.mesh.tet_mesh import FloatArray, IntArray
from surgsim_env.palpation.touch_memory import Indenter
from surgsim_env.scene.anatomy import Anatomy

# Presses shallower than this share of the scene's press depth are ignored: they hardly depend on deeper tissue.
DEPTH_SHARE = 0.35
# Standard deviation of a touch's Gaussian weight, in contact radii sqrt(R d), and its cut-off in deviations.
WIDTH, REACH = 0.55, 2.0
# Least sum of weights at which a node counts as felt.
WEIGHT_LEAST = 0.5


class FeltMap:
    """Ratio of the measured force to Hertz's for the scene's healthy tissue, at each surface node.

    With Hertz's force h(d) of a ball on a half space, touches of force f at depths d give a node the contrast
    sum(w f h) / sum(w h^2) (weighted least squares), so that deep touches count most, as in `palpation.touch_memory`.

    Fields:
        nodes: indices of the surface nodes                                      (n_surface,)
        contrast: the ratio; 0 without touches                                   (n_surface,)
        felt: whether the weights of the touches suffice                         (n_surface,)
        version: increases with each change
    """

    def __init__(self, anatomy: Anatomy) -> None:
        """Begin without touches."""
        scene = anatomy.scene
        self.nodes: IntArray = anatomy.mesh.boundary_nodes
        self._tree = KDTree(anatomy.mesh.points[self.nodes])
        self._indenter = Indenter(scene.instrument.tip_radius, scene.material)
        self._depth_least = DEPTH_SHARE * scene.palpation.press_depth
        contact = (scene.instrument.tip_radius * scene.palpation.press_depth) ** 0.5
        # Not finer than the mesh.
        self._width = max(WIDTH * contact, 0.6 * anatomy.palpable_cell)
        self._radius = scene.instrument.tip_radius
        self.version = 0
        self.clear()

    def clear(self) -> None:
        """Delete all touches."""
        self._product, self._square, self._weight = np.zeros((3, len(self.nodes)))
        self.version += 1

    def feel(self, tip: FloatArray, depth: float, force: float) -> None:
        """Add a touch: the tip's centre [m], (3,), its depth below the surface at rest [m], the force's size [N]."""
        if depth < self._depth_least or force <= 0.0:
            return
        # Distance of the tip's centre from the surface at rest, on either side.
        away = abs(self._radius - depth)
        near = self._tree.query_ball_point(tip, away + REACH * self._width)
        if not near:
            return
        across = np.linalg.norm(self._tree.data[near] - tip, axis=1)
        across = np.sqrt(np.maximum(across**2 - away**2, 0.0))
        weight = np.exp(-0.5 * (across / self._width) ** 2)
        healthy = self._indenter.force(depth)
        self._product[near] += weight * force * healthy
        self._square[near] += weight * healthy**2
        self._weight[near] = np.minimum(self._weight[near] + weight, 1e6)
        self.version += 1

    @property
    def felt(self) -> np.ndarray:
        """Whether a node counts as felt, (n_surface,)."""
        return self._weight >= WEIGHT_LEAST

    @property
    def contrast(self) -> FloatArray:
        """Force over Hertz's, 0 without touches, (n_surface,)."""
        return np.divide(self._product, self._square, out=np.zeros_like(self._product), where=self._square > 0.0)
