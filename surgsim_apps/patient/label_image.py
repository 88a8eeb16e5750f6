"""Chosen labels of a scan: cropped, placed in the patient, and reduced to one connected part for meshing."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from msdm_core.errors import MeshError
from msdm_core.meshing import largest_part, parts_of
from surgsim_apps.patient.label_readers import ImageGeometry, LabelSource, read_labels
from surgsim_apps.patient.materials import check_name, is_lesion

IMAGE_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".mha", ".dcm")
FORM = "--labels NAME=LABEL,... with the organ first, such as liver=1,lesion=2"
# Smallest volume of a lesion over a cell's: a ball of half a cell's radius (the rule of `msdm_core.material.Lesion`).
SMALLEST_SHARE_OF_CELL = np.pi / 6.0
# Most lesions of a label, the largest of its parts; the others are noise.
PARTS_MOST = 24
# Tags are bytes, and 0 is outside.
NAMES_MOST = 255


@dataclass(frozen=True)
class LabelName:
    """A tissue's name and its label in the image."""

    name: str
    value: int


def parse_labels(text: str, smallest: int = 1) -> tuple[LabelName, ...]:
    """Tissues of a text such as "liver=1,lesion=2", the organ first; labels below `smallest` are outside.

    Raises:
        MeshError: a part that breaks the form, a name or a label given twice.
    """
    names = []
    for part in text.split(","):
        name, equals, value = part.partition("=")
        name = name.strip()
        if not equals or not re.fullmatch(r"\s*\d{1,10}\s*", value):
            raise MeshError(f"--labels: {part!r} is no NAME=LABEL; give {FORM}")
        if int(value) < smallest:
            raise MeshError(f"--labels: {part!r}: label 0 is outside; give {FORM}")
        names.append(LabelName(check_name(name, "--labels"), int(value)))
    for entries in ([label.name for label in names], [label.value for label in names]):
        twice = next((entry for entry in entries if entries.count(entry) > 1), None)
        if twice is not None:
            raise MeshError(f"--labels: {twice!r} is given twice; each tissue has one label of its own")
    return tuple(names)


@dataclass(frozen=True, eq=False)
class LabelImage:
    """Part of a label image.

    Fields:
        tags: n for the n-th of `names`, counted from 1; 0 outside       (n_x, n_y, n_z) uint8
        names: of the tissues, the organ first
        geometry: of this part
        corner: its first voxel in the whole image                       (3,)
        shape: of the whole image                                        (3,)
        notes: assumptions about the file, for the report
    """

    tags: NDArray[np.uint8]
    names: tuple[str, ...]
    geometry: ImageGeometry
    corner: tuple[int, int, int]
    shape: tuple[int, int, int]
    notes: tuple[str, ...] = ()

    @property
    def voxel_volume(self) -> float:
        """Volume of a voxel [m^3]."""
        return float(np.prod(self.geometry.spacing))


def is_image(file: Path) -> bool:
    """True for an extension of label images."""
    return file.name.lower().endswith(IMAGE_SUFFIXES)


def read_label_image(file: Path, labels: Sequence[LabelName]) -> LabelImage:
    """Read the named labels of an image file.

    Raises:
        MeshError: a file that is missing, unreadable, sheared or not of three axes; values that are not whole numbers;
            a label that is nowhere in it (lists those that are).
    """
    if not file.is_file():
        raise MeshError(f"{file}: no such file; check the path (current folder: {Path.cwd()})")
    source = read_labels(file, [label.value for label in labels])
    tags = np.zeros(source.values.shape, dtype=np.uint8)
    for tag, label in enumerate(labels, start=1):
        chosen = source.values == label.value
        if not chosen.any():
            raise MeshError(
                f"{file}: label {label.value} ({label.name!r}) is nowhere in the image; there are {_there(source)}: "
                "correct --labels"
            )
        tags[chosen] = tag
    return _cropped(tags, labels, source)


def _there(source: LabelSource) -> str:
    known = [int(value) for value in np.unique(source.values) if value]
    dots = ", ..." if len(known) > 20 else ""
    return f"labels {', '.join(map(str, known[:20]))}{dots}" if known else "no labels at all, every voxel is 0"


def _cropped(tags: NDArray[np.uint8], labels: Sequence[LabelName], source: LabelSource) -> LabelImage:
    box = []
    for axis in range(3):
        used = np.flatnonzero(tags.any(axis=tuple({0, 1, 2} - {axis})))
        box.append(slice(int(used[0]), int(used[-1]) + 1))
    x, y, z = (span.start for span in box)
    return LabelImage(
        np.ascontiguousarray(tags[tuple(box)]),
        tuple(label.name for label in labels),
        source.geometry.moved(np.array([x, y, z], dtype=np.float64)),
        (x, y, z),
        source.values.shape,
        source.notes,
    )


@dataclass(frozen=True, eq=False)
class CleanLabels:
    """Labels of one body.

    Fields:
        tags: n for the n-th of `names`, counted from 1, 0 outside       (n_x, n_y, n_z) uint8
        names: the organ first; parts of a lesion's label are numbered, the largest first
        lesions: names of the lesions' regions
        notes: remarks on dropped, filled and unusual parts
        image: the labels before cleaning
    """

    tags: NDArray[np.uint8]
    names: tuple[str, ...]
    lesions: tuple[str, ...]
    notes: tuple[str, ...]
    image: LabelImage


def clean_labels(image: LabelImage, *, cell_size: float, mend: bool) -> CleanLabels:
    """Largest part of the labels, with its lesions as regions of their own, its cavities filled if `mend`.

    A part of a lesion too small for the cells becomes healthy tissue, with a note.

    Raises:
        MeshError: numbering the lesions gives two regions the same name, or there are more regions than tags.
    """
    tags, notes = _one_part(image)
    filled, cavity_notes = _cavities(tags, image, mend)
    notes += [*_at_border(tags, image), *cavity_notes]
    names = [image.names[0]]
    result, lesions = np.where(filled > 0, np.uint8(1), np.uint8(0)), list[str]()
    smallest = SMALLEST_SHARE_OF_CELL * (cell_size * cell_size * cell_size)
    for tag, name in enumerate(image.names[1:], start=2):
        chosen = filled == tag
        if not chosen.any():
            notes.append(f"{name}: none of it lies in the largest part; left out")
            continue
        numbers, count, left, left_voxels = _parts(chosen, smallest / image.voxel_volume, split=is_lesion(name))
        if left:
            millilitres = left_voxels * image.voxel_volume * 1e6
            beyond = f"beyond the {PARTS_MOST} largest or " if count == PARTS_MOST else ""
            notes.append(
                f"{name}: {left} part(s), {millilitres:.3g} ml together, are {beyond}smaller than what "
                f"cells of {cell_size * 1e3:.3g} mm can show ({smallest * 1e6:.2g} ml) and became {image.names[0]}"
            )
        added = [name if count == 1 else f"{name} {number}" for number in range(1, count + 1)]
        _check_names(names, added, name)
        for number, box in enumerate(ndimage.find_objects(numbers), start=1):
            # A mask of the whole image would take a byte a voxel.
            result[box][numbers[box] == number] = len(names) + number
        names += added
        lesions += added if is_lesion(name) else []
    return CleanLabels(result, tuple(names), tuple(lesions), tuple(notes), image)


def _one_part(image: LabelImage) -> tuple[NDArray[np.uint8], list[str]]:
    organ, corner, dropped = largest_part(image.tags, list(range(1, len(image.names) + 1)))
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


def _parts(chosen: NDArray[np.bool_], smallest: float, *, split: bool) -> tuple[NDArray[np.uint8], int, int, int]:
    """Numbers from 1 of the parts of a mask with at least `smallest` voxels, largest first, 0 elsewhere.

    Beside them their count, and count and voxels of the other parts; without `split` the mask is a single part.
    """
    if not split:
        count = int(np.count_nonzero(chosen))
        kept_all = count >= smallest
        return chosen.astype(np.uint8) * np.uint8(kept_all), int(kept_all), int(not kept_all), 0 if kept_all else count
    label, count = parts_of(chosen, corners=True)
    sizes = np.bincount(label.ravel(), minlength=count + 1)[1:]
    kept = [part for part in np.argsort(-sizes, kind="stable")[:PARTS_MOST].tolist() if sizes[part] >= smallest]
    numbers = np.zeros(count + 1, dtype=np.uint8)
    numbers[[part + 1 for part in kept]] = np.arange(1, len(kept) + 1)
    return numbers[label], len(kept), count - len(kept), int(sizes.sum() - sizes[kept].sum())


def _check_names(names: list[str], added: list[str], label: str) -> None:
    """Refuse a name that is taken, and more regions than tags."""
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
