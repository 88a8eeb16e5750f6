"""Voxels inside a broken surface: what most of the lines that leave it as often as they enter it say."""

import numpy as np
import pytest

from surgsim_apps.patient.surface_files import voxels_inside

STEP = 0.01
# Of a block along its edges; its faces lie half way between voxels' centres, the first of which are at 0.
COUNTS = (5, 4, 3)
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
# Two outward triangles a face.
FACES = {
    "-x": ((0, 1, 3), (0, 3, 2)),
    "+x": ((4, 6, 7), (4, 7, 5)),
    "-y": ((0, 4, 5), (0, 5, 1)),
    "+y": ((2, 3, 7), (2, 7, 6)),
    "-z": ((0, 2, 6), (0, 6, 4)),
    "+z": ((1, 5, 7), (1, 7, 3)),
}


def block(*missing):
    """Vertices [m] and triangles of a block without some of its faces."""
    kept = [triangle for name, two in FACES.items() if name not in missing for triangle in two]
    return (CORNERS * COUNTS - 0.5) * STEP, np.array(kept, dtype=np.int64)


def is_block(inside, first, *corners):
    """True if just the voxels of blocks with these first voxels are inside; of one at 0 by default."""
    expected = np.zeros(inside.shape, dtype=bool)
    for corner in corners or [(0, 0, 0)]:
        expected[tuple(slice(low, low + n) for low, n in zip(np.array(corner) - first, COUNTS))] = True
    return np.array_equal(inside, expected)


def test_a_closed_block_has_its_voxels_with_a_vote_and_without():
    for vote in (False, True):
        assert is_block(*voxels_inside(*block(), STEP, vote=vote))


@pytest.mark.parametrize(
    "missing",
    [
        # Lines that leave and never entered, or never leave, have no vote: along y alone, and along none but x.
        ("-x", "-z"),
        ("-x", "+z"),
        ("+y", "-z"),
        # Lines along z meet nothing, and are outvoted.
        ("-z", "+z"),
    ],
)
def test_what_shows_through_holes_is_outvoted(missing):
    assert is_block(*voxels_inside(*block(*missing), STEP, vote=True))


def test_where_two_open_blocks_look_is_outside():
    """Lines out of both openings cross there, and neither comes to an end: the third alone has a vote."""
    (vertices, left), (others, low) = block("+x"), block("+z")
    at_left, below = (0, 0, COUNTS[2] + 2), (COUNTS[0] + 2, 0, 0)
    both = np.concatenate([vertices + np.array(at_left) * STEP, others + np.array(below) * STEP])
    triangles = np.concatenate([left, low + len(vertices)])
    assert is_block(*voxels_inside(both, triangles, STEP, vote=True), at_left, below)


def test_two_loose_sheets_enclose_nothing():
    """Lines across them enter and leave, lines along them on either side do neither: one against two."""
    assert not voxels_inside(*block("-x", "+x", "-y", "+y"), STEP, vote=True)[0].any()
