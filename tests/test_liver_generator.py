"""The shipped liver is what its generator writes, and is a body fit to be meshed.

The files are compared byte for byte: the generator rounds coordinates to one micrometre,
some 1e7 times the last-bit noise of its arithmetic (it uses no random numbers and no
BLAS-sized product), so another machine's floating point does not reach the file.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

MESHES = Path(__file__).resolve().parents[1] / "scenes" / "meshes"
COMMITTED = MESHES / "liver.ply"
INNER_POINT = (-0.060, -0.015, 0.034)  # m, in the thick of the right lobe, sees the whole surface


@pytest.fixture(scope="module")
def mesh() -> "trimesh.Trimesh":
    """The committed liver, its vertices neither merged nor reordered."""
    return trimesh.load(COMMITTED, process=False)


@pytest.mark.slow
def test_generator_writes_the_committed_file(tmp_path: Path) -> None:
    written = tmp_path / "liver.ply"
    subprocess.run([sys.executable, str(MESHES / "make_liver.py"), str(written)], check=True, timeout=600)
    if written.read_bytes() != COMMITTED.read_bytes():
        new, old = (trimesh.load(path, process=False) for path in (written, COMMITTED))
        gap = "other counts"
        if new.vertices.shape == old.vertices.shape:
            gap = f"vertices differ by up to {np.abs(new.vertices - old.vertices).max():.3g} m"
        pytest.fail(f"make_liver.py no longer writes the committed liver.ply ({gap})")


def test_liver_is_one_closed_outward_body(mesh: "trimesh.Trimesh") -> None:
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert mesh.euler_number == 2
    assert mesh.volume > 0.0


def test_liver_does_not_cross_itself(mesh: "trimesh.Trimesh") -> None:
    """Every triangle faces away from one inner point: the surface covers each direction once."""
    faces_away = np.sum(mesh.face_normals * (mesh.triangles_center - INNER_POINT), axis=1)
    assert faces_away.min() > 5e-3


def test_liver_has_human_size(mesh: "trimesh.Trimesh") -> None:
    assert 1.4e-3 <= mesh.volume <= 1.6e-3  # m^3
    assert np.all(mesh.extents >= [0.210, 0.140, 0.130])
    assert np.all(mesh.extents <= [0.230, 0.160, 0.160])
    np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0.0, atol=2e-6)
    # Right lobe (negative x) much the larger, and the dome's top over it.
    assert mesh.center_mass[0] < -0.01
    assert mesh.vertices[mesh.vertices[:, 2].argmax(), 0] < 0.0


def test_liver_triangles_are_even_and_its_edges_soft(mesh: "trimesh.Trimesh") -> None:
    assert COMMITTED.stat().st_size < 300_000
    assert 2500 <= len(mesh.vertices) <= 4000
    lengths = mesh.edges_unique_length
    assert lengths.min() > 2.5e-3 and lengths.max() < 10e-3
    assert 5e-3 < np.median(lengths) < 8e-3
    # A ball of 7 mm touching the surface from within at any vertex stays inside, but for
    # the sagitta of the facets (an 8 mm chord on a 7 mm ball: 1.3 mm).
    centres = mesh.vertices - 7e-3 * mesh.vertex_normals
    surface = np.concatenate([mesh.triangles_center, mesh.vertices])
    parts = np.array_split(centres, 30)
    nearest = [np.linalg.norm(part[:, None] - surface, axis=2).min() for part in parts]
    assert min(nearest) > 6e-3
