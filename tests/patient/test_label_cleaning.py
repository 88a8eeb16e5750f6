"""Labels made ready to be meshed: their parts are numbered."""

import numpy as np
import pytest

from surgsim_apps.patient.label_image import LabelImage, clean_labels
from surgsim_apps.patient.label_readers import ImageGeometry


def image_of(tags, names):
    geometry = ImageGeometry.from_matrix(np.diag([1e-3, 1e-3, 1e-3]), np.zeros(3), "image")
    return LabelImage(tags, tuple(names), geometry, (1, 1, 1), tuple(n + 2 for n in tags.shape))


def with_blocks(side, places, tag=2):
    """An organ with blocks of 4 voxels a side."""
    tags = np.ones((side,) * 3, dtype=np.uint8)
    for x, y, z in places:
        tags[x : x + 4, y : y + 4, z : z + 4] = tag
    return tags


def test_parts_of_a_lesion_are_numbered_by_size():
    tags = with_blocks(30, [(2, 2, 2), (12, 12, 12)])
    tags[12:17, 12:16, 12:16] = 2
    clean = clean_labels(image_of(tags, ["liver", "lesion"]), cell_size=0.004, mend=False)
    assert clean.names == ("liver", "lesion 1", "lesion 2")
    assert clean.lesions == clean.names[1:]
    assert clean.tags[14, 14, 14] == 2
    assert clean.tags[3, 3, 3] == 3
    assert np.bincount(clean.tags.ravel()).tolist() == [0, 27000 - 64 - 80, 80, 64]


@pytest.mark.parametrize(("side", "kept"), [(4, False), (5, True)])
def test_a_region_that_is_no_lesion_is_whole_and_dropped_where_cells_cannot_show_it(side, kept):
    """Cells of 6 mm show a ball of half a cell's radius, 113 voxels: not two of 4 x 4 x 3, but two of 5 x 4 x 3."""
    tags = np.ones((30, 30, 30), dtype=np.uint8)
    tags[2 : 2 + side, 2:6, 2:5] = tags[20 : 20 + side, 20:24, 20:23] = 2
    count = 2 * side * 4 * 3
    clean = clean_labels(image_of(tags, ["liver", "vessel"]), cell_size=0.006, mend=False)
    assert clean.lesions == ()
    if kept:
        assert (clean.names, clean.notes) == (("liver", "vessel"), ())
        assert np.array_equal(clean.tags == 2, tags == 2)
    else:
        assert clean.names == ("liver",)
        assert np.array_equal(clean.tags, np.ones_like(tags))
        (note,) = clean.notes
        assert note.startswith(
            f"vessel: 1 part(s), {count / 1000:.3g} ml together, are smaller than what cells of 6 mm"
        )
        assert note.endswith("and became liver")


def test_a_label_apart_from_the_organ_is_left_out_and_said():
    tags = np.zeros((30, 30, 30), dtype=np.uint8)
    tags[2:20, 2:20, 2:20], tags[24:28, 24:28, 24:28] = 1, 2
    clean = clean_labels(image_of(tags, ["liver", "lesion"]), cell_size=0.004, mend=False)
    assert (clean.names, clean.lesions) == (("liver",), ())
    assert clean.tags.max() == 1
    assert clean.notes[-1] == "lesion: none of it lies in the largest part; left out"
