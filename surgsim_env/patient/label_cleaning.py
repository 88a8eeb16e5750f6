"""Labels prepared for meshing: one connected part, each lesion a region of its own, cavities filled on request."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from msdm_core.errors import MeshError
from msdm_core.meshing.segmentation_meshing import largest_part, parts_of
from surgsim_env.patient.label_image import LabelImage
from surgsim_env.patient.materials import is_lesion

# A lesion smaller than a ball of half a cell's radius cannot be shown (the rule of
# `msdm_core.material.regions.Lesion`).
SMALLEST_SHARE_OF_CELL = np.pi / 6.0
# Of a label's parts at most this many, the largest, are lesions; the rest is noise.
PARTS_MOST = 24
# Tags are bytes, and 0 is outside.
NAMES_MOST = 255


@dataclass(frozen=True, eq=False)
class CleanLabels:
    """Labels of one body.

    Fields:
        tags: n for the n-th of `names`, counted from 1, 0 outside       (n_x, n_y, n_z) uint8
        names: the organ first; parts of a lesion's label are numbered, the largest first
        lesions: names of the regions that are lesions
        notes: remarks on what was dropped, filled or is unusual
        image: the labels before cleaning
    """

    tags: NDArray[np.uint8]
    names: tuple[str, ...]
    lesions: tuple[str, ...]
    notes: tuple[str, ...]
    image: LabelImage


def clean_labels(image: LabelImage, *, cell_size: float, mend: bool) -> CleanLabels:
    """The largest part of the labels, with its lesions as regions of their own, its cavities filled if `mend`.

    A part of a lesion too small for the cells becomes healthy tissue, with a note.

    Raises:
        MeshError: numbering the lesions gives two regions the same name, or there are more regions than tags.
    """
    tags, notes = _one_part(image)
    notes += _at_border(tags, image)
    filled, more = _cavities(tags, image, mend)
    notes += more
    names = [image.names[0]]
    result = np.where(filled > 0, np.uint8(1), np.uint8(0))
    lesions = []
    smallest = SMALLEST_SHARE_OF_CELL * cell_size**3
    for tag, name in enumerate(image.names[1:], start=2):
        chosen = filled == tag
        if not chosen.any():
            notes.append(f"{name}: none of it lies in the largest part; left out")
            continue
        parts = _parts(chosen, smallest / image.voxel_volume, split=is_lesion(name))
        if parts.left_count:
            millilitres = parts.left_voxels * image.voxel_volume * 1e6
            beyond = f"beyond the {PARTS_MOST} largest or " if parts.count == PARTS_MOST else ""
            notes.append(
                f"{name}: {parts.left_count} part(s), {millilitres:.3g} ml together, are {beyond}smaller than what "
                f"cells of {cell_size * 1e3:.3g} mm can show ({smallest * 1e6:.2g} ml) and became {image.names[0]}"
            )
        added = [name if parts.count == 1 else f"{name} {number}" for number in range(1, parts.count + 1)]
        _check_names(names, added, name)
        for number, one in enumerate(ndimage.find_objects(parts.numbers), start=1):
            # One bounding box at a time: a mask of the whole image takes a byte a voxel.
            result[one][parts.numbers[one] == number] = len(names) + number
        names += added
        lesions += added if is_lesion(name) else []
    return CleanLabels(result, tuple(names), tuple(lesions), tuple(notes), image)


def _one_part(image: LabelImage) -> tuple[NDArray[np.uint8], list[str]]:
    every = list(range(1, len(image.names) + 1))
    organ, corner, dropped = largest_part(image.tags, every)
    tags = np.zeros_like(image.tags)
    box = tuple(slice(low, low + n) for low, n in zip(corner, organ.shape, strict=True))
    tags[box] = np.where(organ, image.tags[box], 0)
    if not dropped:
        return tags, []
    share = sum(dropped) / (np.count_nonzero(organ) + sum(dropped))
    sizes = ", ".join(f"{size * image.voxel_volume * 1e6:.3g}" for size in dropped[:5])
    return tags, [
        f"{len(dropped)} part(s) apart from the largest were left out: {sum(dropped)} voxels, {share:.2%} of all "
        f"({sizes}{', ...' if len(dropped) > 5 else ''} ml)"
    ]


def _at_border(tags: NDArray[np.uint8], image: LabelImage) -> list[str]:
    notes = []
    for axis in range(3):
        used = np.flatnonzero(tags.any(axis=tuple({0, 1, 2} - {axis}))) + image.corner[axis]
        for touches, high in ((used[0] == 0, False), (used[-1] == image.shape[axis] - 1, True)):
            if touches:
                notes.append(
                    f"the organ touches the image's border towards the {image.geometry.side(axis, high=high)}: it is "
                    "cut off there, and ends in a flat face"
                )
    return notes


def _cavities(tags: NDArray[np.uint8], image: LabelImage, mend: bool) -> tuple[NDArray[np.uint8], list[str]]:
    inside = tags > 0
    holes = np.asarray(ndimage.binary_fill_holes(inside), dtype=bool) & ~inside
    count = parts_of(holes)[1]
    if not count:
        return tags, []
    size = f"{count} cavity(ies) inside the labels, {np.count_nonzero(holes) * image.voxel_volume * 1e6:.3g} ml"
    if not mend:
        return tags, [f"{size}, were left as they are (--mend fills them)"]
    return np.where(holes, np.uint8(1), tags), [f"mended: {size}, were filled with {image.names[0]}"]


@dataclass(frozen=True, eq=False)
class _Parts:
    """The parts of a label that are kept, numbered from 1 (0 elsewhere), and the size of the rest."""

    numbers: NDArray[np.uint8]
    count: int
    left_count: int
    left_voxels: int


def _parts(chosen: NDArray[np.bool_], smallest: float, *, split: bool) -> _Parts:
    """The parts of a mask with at least `smallest` voxels, largest first; without `split` the mask is one part."""
    if not split:
        count = int(np.count_nonzero(chosen))
        if count < smallest:
            return _Parts(np.zeros(chosen.shape, dtype=np.uint8), 0, 1, count)
        return _Parts(chosen.astype(np.uint8), 1, 0, 0)
    label, count = parts_of(chosen, corners=True)
    sizes = np.bincount(label.ravel(), minlength=count + 1)[1:]
    kept = [part for part in np.argsort(-sizes, kind="stable")[:PARTS_MOST].tolist() if sizes[part] >= smallest]
    numbers = np.zeros(count + 1, dtype=np.uint8)
    numbers[[part + 1 for part in kept]] = np.arange(1, len(kept) + 1)
    return _Parts(numbers[label], len(kept), count - len(kept), int(sizes.sum() - sizes[kept].sum()))


def _check_names(names: list[str], added: list[str], label: str) -> None:
    """Raise a MeshError for a name that is taken, or for more regions than there are tags."""
    twice = next((name for name in added if name in names), None)
    if twice is not None:
        raise MeshError(
            f"region {twice!r} would be there twice: the parts of label {label!r} are numbered, and another label has "
            "that name; give one of the two another name in --labels"
        )
    if len(names) + len(added) > NAMES_MOST:
        raise MeshError(
            f"{len(names) + len(added)} regions are there once the parts of {label!r} are numbered; at most "
            f"{NAMES_MOST} can be told apart: name fewer labels in --labels, or choose larger cells (--cell-size)"
        )
