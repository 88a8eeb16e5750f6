"""What the tips have felt so far, spread over the organ's surface: how stiff it is for its place and depth."""

import numpy as np
from scipy.spatial import KDTree

from msdm_core.mesh import FloatArray, IntArray
from surgsim_env.anatomy import Anatomy
from surgsim_env.palpation.touch_memory import Indenter

# Presses shallower than this share of the scene's depth say little of what lies below.
DEPTH_SHARE = 0.35
# A touch speaks for what is around it with a Gaussian of this width, in contact radii sqrt(R d), and this far.
WIDTH, REACH = 0.55, 2.0
# A node that touches have said this much of, in full touches, is felt.
WEIGHT_LEAST = 0.5


class FeltMap:
    """Stiffness of what was touched over Hertz's for the scene's tissue, at each surface node.

    A touch of force f at depth d counts as f / h(d), h being a ball's on a half space; of many touches around a node
    the contrast is sum(w f h) / sum(w h^2), deep ones counting most, as in `palpation.touch_memory`.

    Fields:
        nodes: of the surface                                                    (n_surface,)
        contrast: 0 where nothing was felt                                       (n_surface,)
        felt: where something was                                                (n_surface,)
        version: goes up with each change
    """

    def __init__(self, anatomy: Anatomy) -> None:
        """Nothing felt."""
        scene = anatomy.scene
        self.nodes: IntArray = anatomy.mesh.boundary_nodes
        self._tree = KDTree(anatomy.mesh.points[self.nodes])
        self._indenter = Indenter(scene.instrument.tip_radius, scene.material)
        self._depth_least = DEPTH_SHARE * scene.palpation.press_depth
        contact = (scene.instrument.tip_radius * scene.palpation.press_depth) ** 0.5
        # Never finer than the mesh.
        self._width = max(WIDTH * contact, 0.6 * anatomy.palpable_cell)
        self._radius = scene.instrument.tip_radius
        self.version = 0
        self.clear()

    def clear(self) -> None:
        """Forget."""
        self._product, self._square, self._weight = np.zeros((3, len(self.nodes)))
        self.version += 1

    def feel(self, tip: FloatArray, depth: float, force: float) -> None:
        """Take in a touch: the tip's centre [m] (3,), its depth below the resting surface [m], the force's size [N]."""
        if depth < self._depth_least or force <= 0.0:
            return
        # The tip's centre is this far from the surface at rest, on either side of it.
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
        """Where enough was felt, (n_surface,)."""
        return self._weight >= WEIGHT_LEAST

    @property
    def contrast(self) -> FloatArray:
        """Force over Hertz's, 0 where nothing was felt, (n_surface,)."""
        return np.divide(self._product, self._square, out=np.zeros_like(self._product), where=self._square > 0.0)
