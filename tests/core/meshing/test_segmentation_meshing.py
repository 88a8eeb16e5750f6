"""Label images filled with tets: volumes, places, shapes, regions, what is left out and what is refused."""

import numpy as np
import pytest

from msdm_core.errors import MeshError
from msdm_core.material.regions import Lesion, Material, lesion_extent
from msdm_core.mesh.quality import mesh_quality
from msdm_core.mesh.tet_mesh import TetMesh
from msdm_core.meshing.segmentation_meshing import fill_labels, mesh_segmentation, smoothed_share

HALF_AXES = np.array([0.040, 0.030, 0.025])
NAMES = {1: "liver", 2: "lesion"}


def ellipsoid(spacing, lesion=0.010):
    """Labels with a ball of 2 in the middle, and the place of the middle [m]."""
    spacing = np.asarray(spacing)
    shape = np.ceil(2 * (HALF_AXES + 0.004) / spacing).astype(int)
    middle = (shape - 1) / 2 * spacing
    place = np.moveaxis(np.indices(shape), 0, -1) * spacing - middle
    labels = (((place / HALF_AXES) ** 2).sum(axis=-1) <= 1).astype(np.int16)
    labels[(place**2).sum(axis=-1) <= lesion**2] = 2
    return labels, middle


def edge_counts(mesh):
    sides = np.sort(mesh.boundary_triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(sides, axis=0, return_counts=True)[1]


@pytest.mark.parametrize("spacing", [(0.001, 0.001, 0.001), (0.0008, 0.0008, 0.005), (0.003, 0.002, 0.0025)])
def test_a_body_keeps_its_volume_its_place_and_its_shape(spacing):
    labels, middle = ellipsoid(spacing)
    filled = fill_labels(labels, spacing, cell_size=0.006, region_names=NAMES)
    # The level is moved until 0.2 % are left.
    assert abs(filled.volume_error) < 0.004
    # The voxels of a smooth body hold its volume but for what chance leaves at its rim, most with slices of 5 mm.
    assert filled.label_volume == pytest.approx(4 / 3 * np.pi * HALF_AXES.prod(), rel=0.01)
    quality = mesh_quality(filled.mesh)
    assert quality.dihedral_smallest_deg > 10
    assert (edge_counts(filled.mesh) == 2).all()
    centred = filled.mesh.points - middle
    radius = np.linalg.norm(centred[filled.mesh.boundary_nodes] / HALF_AXES, axis=1)
    # Within half of the widest voxel, that is 0.5 x spacing of 25 mm.
    assert np.abs(radius - 1).max() < 0.5 * max(spacing) / HALF_AXES.min()
    centre = filled.mesh.volumes @ filled.mesh.points[filled.mesh.tets].mean(axis=1) / filled.mesh.volumes.sum()
    np.testing.assert_allclose(centre, middle, atol=2e-4)


def test_smoothing_alone_takes_volume_and_the_level_gives_it_back():
    spacing = (0.0008, 0.0008, 0.005)
    labels, _ = ellipsoid(spacing)
    filled = fill_labels(labels, spacing, cell_size=0.006, region_names=NAMES)
    field = smoothed_share(labels > 0, np.zeros(3, dtype=np.int64), np.array(spacing), 0.006)
    change = field.volume_above(0.5) / filled.label_volume - 1.0
    assert field.smoothing == pytest.approx(0.7 * 0.005)
    # A Gaussian of deviation s moves the level 1/2 of a sphere of radius R inward by s^2 / R, 3 s^2 / R^2 of all,
    # with R^2 = 3 / (1/a^2 + 1/b^2 + 1/c^2) here.
    expected = -(field.smoothing**2) * (1 / HALF_AXES**2).sum()
    assert change == pytest.approx(expected, rel=0.5)
    assert abs(filled.volume_error) < 0.2 * abs(change)


def test_regions_keep_volume_and_place():
    labels, middle = ellipsoid((0.001, 0.001, 0.001))
    filled = fill_labels(labels, (0.001, 0.001, 0.001), cell_size=0.005, region_names=NAMES)
    mesh = filled.mesh
    assert mesh.region_names == ((1, "liver"), (2, "lesion"))
    # To half a tet, a^3 / 24.
    tagged = mesh.volumes[mesh.region == 2].sum()
    assert abs(tagged - filled.region_volumes[2]) < 0.005**3 / 24
    centre, half_axes = lesion_extent(mesh, Lesion(region="lesion", material=Material(1e4, 1e3), name="lesion"))
    np.testing.assert_allclose(centre, middle, atol=5e-4)
    np.testing.assert_allclose(half_axes, 0.010, rtol=0.06)


def test_extent_of_a_region_that_is_an_ellipsoid_of_whole_tets():
    """Variances of tets are exact: a block of them has L^2 / 12 along each axis, an ellipsoid a^2 / 5."""
    from msdm_core.meshing.lattice_meshing import box_mesh

    block = box_mesh((0.06, 0.04, 0.02), (6, 4, 2))
    mesh = TetMesh(block.points, block.tets, np.full(block.tet_count, 7), {7: "all"})
    centre, half_axes = lesion_extent(mesh, Lesion(region="all", material=Material(1e4, 1e3)))
    np.testing.assert_allclose(centre, [0.03, 0.02, 0.01], atol=1e-12)
    np.testing.assert_allclose(half_axes, np.sqrt(5 / 12) * np.array([0.06, 0.04, 0.02]), rtol=1e-9)


def test_parts_beside_the_largest_are_left_out_and_said():
    labels, _ = ellipsoid((0.002, 0.002, 0.002))
    alone = fill_labels(labels, (0.002,) * 3, cell_size=0.008, region_names={1: "liver"})
    # One outside the largest part's box, one in a corner of it, where a round body leaves room.
    labels[-2:, 0, 0] = 1
    x, y, z = np.argwhere(labels == 1)[:-2].min(axis=0) + 3
    labels[x, y, z] = 1
    with pytest.warns(UserWarning, match=r"2 part\(s\) of 3 voxels"):
        mesh = mesh_segmentation(labels, (0.002,) * 3, cell_size=0.008, region_names={1: "liver"})
    assert mesh.points.tobytes() == alone.mesh.points.tobytes()
    assert (
        fill_labels(labels, (0.002,) * 3, cell_size=0.008, region_names={1: "liver"}).label_volume == alone.label_volume
    )


def test_only_named_labels_are_filled():
    labels, _ = ellipsoid((0.002, 0.002, 0.002))
    half = labels.copy()
    half[half.shape[0] // 2 :][half[half.shape[0] // 2 :] > 0] = 9
    whole, part = (
        mesh_segmentation(image, (0.002,) * 3, cell_size=0.008, region_names={1: "liver"}) for image in (labels, half)
    )
    assert part.volumes.sum() == pytest.approx(0.5 * whole.volumes.sum(), rel=0.15)


def test_where_the_image_begins_does_not_matter():
    labels, _ = ellipsoid((0.002, 0.002, 0.002))
    first = mesh_segmentation(labels, (0.002,) * 3, cell_size=0.008, region_names=NAMES)
    padded = mesh_segmentation(
        np.pad(labels, ((5, 0), (2, 7), (0, 1))), (0.002,) * 3, cell_size=0.008, region_names=NAMES
    )
    np.testing.assert_allclose(padded.points - [0.010, 0.004, 0.0], first.points, atol=1e-12)
    np.testing.assert_array_equal(padded.region, first.region)


def test_a_label_at_the_border_is_closed_there():
    labels = np.ones((20, 20, 20), dtype=np.uint8)
    mesh = mesh_segmentation(labels, (0.002,) * 3, cell_size=0.006, region_names={1: "block"})
    assert (edge_counts(mesh) == 2).all()
    assert mesh.volumes.sum() == pytest.approx(0.04**3, rel=0.01)


GOOD = np.pad(np.ones((10, 10, 10), dtype=np.uint8), 1)


@pytest.mark.parametrize(
    ("labels", "spacing", "cell_size", "names", "named"),
    [
        (GOOD, (0.004,) * 3, 0.008, {3: "kidney"}, "label 3 .*kidney"),
        (GOOD, (0.004,) * 3, 0.030, {1: "a"}, "0.03 .*0.01 m"),
    ],
)
def test_what_cannot_be_filled_is_refused(labels, spacing, cell_size, names, named):
    with pytest.raises(MeshError, match=named):
        mesh_segmentation(labels, spacing, cell_size=cell_size, region_names=names)
