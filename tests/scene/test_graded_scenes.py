"""Scenes whose organ is fine at its palpable face alone: the option is read, and the face is as in the uniform one."""

import tomllib

import numpy as np
import pytest

from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene, scene_from_table, scenes_folder


def changed_scene(name, kind, **entries):
    folder = scenes_folder() / "organs"
    table = tomllib.loads((folder / f"{name}.toml").read_text(encoding="utf-8"))
    table["mesh"][kind].update(entries)
    table["mesh"][kind] = {key: value for key, value in table["mesh"][kind].items() if value is not None}
    return scene_from_table(table, name=name, folder=folder)


def longest_edges(face):
    corners = face.points[face.triangles]
    return np.linalg.norm(np.roll(corners, 1, axis=1) - corners, axis=2).max(axis=1)


@pytest.mark.slow
def test_graded_liver_has_the_palpable_face_of_the_uniform_one():
    """Cell <= contact radius over the palpable face, with at most 0.4 of the uniform lattice's nodes."""
    uniform = load_anatomy(changed_scene("liver", "surface", coarse_cell_size=None))
    graded = load_anatomy(make_scene("liver"))
    cell_size = graded.scene.mesh.surface.cell_size
    assert cell_size <= (graded.scene.instrument.tip_radius * graded.scene.palpation.press_depth) ** 0.5
    assert graded.mesh.node_count <= 0.4 * uniform.mesh.node_count
    assert (longest_edges(graded.face) <= 2**0.5 * cell_size).mean() > 0.995
    spacing = uniform.scene.palpation.site_spacing
    sites, others = (anatomy.face.raster(spacing)[0] for anatomy in (uniform, graded))
    # The raster starts from the face's extent, which may move by a rim triangle: compare the faces, not the sites.
    assert len(others) == pytest.approx(len(sites), rel=0.03)
    offset = [np.linalg.norm(graded.face.project(site)[0] - site) for site in sites]
    assert np.median(offset) < 1e-4 and max(offset) < 1e-3
