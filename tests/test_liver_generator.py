"""The shipped liver is what its generator writes, and is one closed body.

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
