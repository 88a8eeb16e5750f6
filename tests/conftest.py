"""Shared fixtures and settings: patience, a browser and random meshes."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from msdm_core.mesh.tet_mesh import TetMesh, tet_volumes
from tests.chromium import CHROMIUM, Chromium

# Nothing that passes depends on how fast it runs.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")


@pytest.fixture(scope="session")
def chromium(tmp_path_factory) -> Iterator[Chromium]:
    """A browser that all tests open their pages in."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here: apt-get install chromium (.ci/run does)")
    with Chromium(tmp_path_factory.mktemp("chromium")) as browser:
        yield browser


@pytest.fixture(scope="session")
def random_mesh() -> Callable[..., TetMesh]:
    """A function that makes an irregular mesh of a 6 cm block with four regions, the same for the same seed."""

    def make(seed: int, cells: int = 3) -> TetMesh:
        generator = np.random.default_rng(seed)
        grid = np.stack(np.meshgrid(*[np.arange(cells + 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        points = (grid + generator.uniform(-0.35, 0.35, grid.shape)) * 0.06 / cells
        triangulation = Delaunay(points)
        tets, neighbours = triangulation.simplices, triangulation.neighbors
        # The hull of jittered points has slivers; without them, the largest part that hangs together by faces is kept.
        thick = np.abs(tet_volumes(points, tets)) > 0.01 * (0.06 / cells) ** 3
        tet, face = np.nonzero((neighbours >= 0) & thick[:, None] & thick[neighbours])
        graph = coo_array((np.ones(len(tet)), (tet, neighbours[tet, face])), shape=(len(tets), len(tets)))
        part = connected_components(graph, directed=False)[1]
        tets = tets[part == np.bincount(part[thick]).argmax()]
        used, tets = np.unique(tets, return_inverse=True)
        names = {0: "parenchyma", 1: "capsule", 2: "lesion deep", 7: "lésion <&'>"}
        tets = tets.reshape(-1, 4)
        return TetMesh(points[used], tets, generator.choice(list(names), len(tets)), names)

    return make
