"""Labels made ready to be meshed: their parts numbered, and names and counts that cannot be."""

import tracemalloc

import numpy as np
import pytest

from msdm_core.errors import MeshError
from surgsim_env.patient.label_image import NAMES_MOST, LabelImage, clean_labels
from surgsim_env.patient.label_readers import ImageGeometry


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


@pytest.mark.parametrize("names", [["liver", "lesion", "lesion 1"], ["liver", "lesion 1", "lesion"]])
def test_a_number_that_makes_a_name_of_another_label_is_refused(names):
    tags = with_blocks(30, [(2, 2, 2), (12, 12, 12)], tag=names.index("lesion") + 1)
    tags[20:24, 20:24, 20:24] = names.index("lesion 1") + 1
    words = "region 'lesion 1' would be there twice: .* give one of the two another name in --labels"
    with pytest.raises(MeshError, match=words):
        clean_labels(image_of(tags, names), cell_size=0.004, mend=False)


def test_more_regions_than_a_byte_can_tell_apart_are_refused():
    names = ["liver", *(f"lesion {letter}" for letter in "abcdefghijk")]
    tags = np.ones((51, 51, 51), dtype=np.uint8)
    corners = np.stack(np.meshgrid(*[np.arange(1, 46, 6)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for number, (x, y, z) in enumerate(corners[: 24 * 11]):
        tags[x : x + 4, y : y + 4, z : z + 4] = 2 + number // 24
    with pytest.raises(MeshError, match=f"265 regions are there .*; at most {NAMES_MOST} can be told apart"):
        clean_labels(image_of(tags, names), cell_size=0.004, mend=False)


def test_many_parts_take_no_masks_of_the_whole_image():
    places = [(x, y, z) for x in (2, 40, 80) for y in (2, 40, 80) for z in (2, 30, 60)]
    image = image_of(with_blocks(120, places), ["liver", "lesion"])
    tracemalloc.start()
    clean = clean_labels(image, cell_size=0.004, mend=False)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(clean.names) == 25
    assert "lesion: 3 part(s), 0.192 ml together, are beyond the 24 largest or smaller than" in clean.notes[-1]
    # Tags of a byte, parts of four bytes, and what numpy's count of them takes, eight; masks of 24 parts would be 24.
    assert peak < 20 * image.tags.size


def test_noise_of_many_parts_takes_no_list_of_their_boxes():
    tags = np.zeros((90, 90, 90), dtype=np.uint8)
    tags[::2, ::2, ::2] = 1
    tags[40:49, 40:49, 40:49] = 1
    tracemalloc.start()
    clean = clean_labels(image_of(tags, ["liver"]), cell_size=0.004, mend=False)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert clean.notes[0].startswith(f"{45**3 - 125} part(s) apart from the largest were left out")
    # Parts of four bytes, numpy's copy of eight to count them, masks; boxes of 91000 parts would be some 45 a voxel.
    assert peak < 24 * tags.size
