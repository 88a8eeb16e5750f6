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
from surgsim_apps.patient.label_readers import (
    SLACK,
    ImageGeometry,
    LabelSource,
    Segment,
    farthest_corner,
    read_labels,
    sides_text,
)
from surgsim_apps.patient.materials import check_name, is_lesion
from surgsim_apps.patient.surface_files import region_name

IMAGE_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")
FORM = (
    "--labels NAME=LABEL,... with the organ first, such as liver=1,lesion=2 (a label is a number or a name of the file)"
)
# Smallest volume of a lesion over a cell's: a ball of half a cell's radius (the rule of `msdm_core.material.Lesion`).
SMALLEST_SHARE_OF_CELL = np.pi / 6.0
# Most lesions of a label, the largest of its parts; the others are noise.
PARTS_MOST = 24
# Tags are bytes, and 0 is outside.
NAMES_MOST = 255
# An organ that ends by itself tapers: its last slice has at most this share of the voxels of the one before. Up to half
# for a dome, and more for a ridge; the rest is for the voxels' steps.
TAPER = 0.6


@dataclass(frozen=True)
class LabelName:
    """A tissue's name, and its label in the image as a number or by the file's name for it."""

    name: str
    value: int | str


def parse_labels(text: str, *, file_count: int = 1, zero_is_outside: bool = True) -> tuple[LabelName, ...]:
    """Tissues of a text such as "liver=1,lesion=2", the organ first; of several files, one of each.

    Raises:
        MeshError: a part that breaks the form, a name given twice, or a label given twice for one file.
    """
    names = []
    for part in text.split(","):
        name, equals, value = map(str.strip, part.partition("="))
        if not equals or not value:
            raise MeshError(f"--labels: {part!r} is no NAME=LABEL; give {FORM}")
        number = int(value) if re.fullmatch(r"-?\d{1,10}", value) else value
        if number == 0 and zero_is_outside:
            raise MeshError(f"--labels: {part!r}: label 0 is outside; give {FORM}")
        names.append(LabelName(check_name(name, "--labels"), number))
    values = [label.value for label in names] if file_count == 1 else []
    for entries in ([label.name for label in names], values):
        _check_distinct(entries, "in --labels each tissue has a label of its own")
    if file_count not in (1, len(names)):
        raise MeshError(
            f"--labels: {len(names)} labels are given for {file_count} files; give each file's, in their order"
        )
    return tuple(names)


def _check_distinct(entries: Sequence[int | str], rule: str) -> None:
    twice = next((entry for entry in entries if entries.count(entry) > 1), None)
    if twice is not None:
        raise MeshError(f"{twice!r} is given twice; {rule}")


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


def read_label_image(
    file: Path, labels: Sequence[LabelName] | None = None, *, others: Sequence[Path] = ()
) -> LabelImage:
    """Read the named labels of an image file, or one label from each of several; where they overlap the later applies.

    Args:
        file: the image.
        labels: the organ's first; without them the only label of each file, named after the file.
        others: images on the grid of the first, one for each further label.

    Raises:
        MeshError: a file that is missing, unreadable, sheared or not of three axes; values that are not whole numbers;
            a label that is nowhere in it (lists those that are), or covered wholly by later ones; files of several
            labels without `labels`; files on other grids.
    """
    files = [file, *others]
    for path in files:
        if not path.is_file():
            raise MeshError(f"{path}: no such file; check the path (current folder: {Path.cwd()})")
    sources = [read_labels(path) for path in files]
    for source in sources[1:]:
        _check_grid(sources[0], source)
    if labels is None:
        labels = [_only_label(source) for source in sources]
        _check_distinct([label.name for label in labels], "rename a file, or name the tissue of each file in --labels")
    return _tagged(list(zip(sources if others else sources * len(labels), labels, strict=True)))


def _only_label(source: LabelSource) -> LabelName:
    if len(source.segments) != 1:
        advice = f"give {FORM}" if source.segments else "leave it out"
        raise MeshError(f"{source.file}: which label is it? {source.segments_text}: {advice}")
    return LabelName(region_name(source.file), source.segments[0].value)


def _segment(source: LabelSource, label: LabelName) -> Segment:
    """The label of a file with a number or a name."""
    fits = [segment for segment in source.segments if label.value == segment.value or label.value in segment.names]
    if not fits:
        raise MeshError(
            f"{source.file}: label {label.value} ({label.name!r}) is nowhere in the image; {source.segments_text}: "
            "correct --labels"
        )
    if len(fits) > 1:
        raise MeshError(
            f"{source.file}: label {label.value} is that of {len(fits)} segments ({'; '.join(map(str, fits))}): choose "
            "by number, name or ID in --labels"
        )
    return fits[0]


def _check_grid(first: LabelSource, other: LabelSource) -> None:
    """Refuse an image with other voxels than the first's."""
    apart = farthest_corner(first.geometry.affine, other.geometry.affine, first.shape)
    if first.shape != other.shape or apart > SLACK * first.geometry.spacing.min():
        grids = [
            f"{' x '.join(map(str, source.shape))} voxels of {sides_text(source.geometry.spacing)}"
            for source in (other, first)
        ]
        raise MeshError(
            f"{other.file}: its grid is not that of {first.file.name}: {' for '.join(grids)}, a voxel lies up to "
            f"{apart * 1e3:.4g} mm apart; resample it by nearest neighbours, as SimpleITK.Resample(image, first_image, "
            "SimpleITK.Transform(), SimpleITK.sitkNearestNeighbor) does"
        )


def _tagged(chosen: Sequence[tuple[LabelSource, LabelName]]) -> LabelImage:
    """Image of labels with one grid, cropped to them; of labels that overlap the later applies, with a note."""
    first = chosen[0][0]
    tags, notes = np.zeros(first.shape, dtype=np.uint8), list[str]()
    volume = float(np.prod(first.geometry.spacing)) * 1e6
    for tag, (source, label) in enumerate(chosen, start=1):
        mask = source.mask(_segment(source, label))
        covered = np.bincount(tags[mask], minlength=tag)
        tags[mask] = tag
        for under in (np.flatnonzero(covered[1:]) + 1).tolist():
            file, lower = chosen[under - 1]
            if not (tags == under).any():
                raise MeshError(
                    f"{file.file}: label {lower.value} ({lower.name!r}) is covered wholly by later ones, the last "
                    f"{label.value} ({label.name!r}): where labels overlap the later applies; give the inner one later"
                )
            notes.append(
                f"{lower.name} and {label.name} overlap in {covered[under]} voxels ({covered[under] * volume:.4g} ml): "
                f"they are {label.name}, the later one"
            )
    (box,) = ndimage.find_objects((tags > 0).view(np.uint8))
    corner = tuple(side.start for side in box)
    stated = dict.fromkeys(f"{source.file.name}: {note}" for source, _ in chosen for note in source.notes)
    return LabelImage(
        np.ascontiguousarray(tags[box]),
        tuple(label.name for _, label in chosen),
        first.geometry.moved(np.array(corner, dtype=np.float64)),
        corner,
        first.shape,
        (*stated, *notes),
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
    """Notes on sides where the organ ends with the image without tapering, so that it may go on outside.

    An image cropped to its labels, as by 3D Slicer, or without empty slices, as in DICOM, touches them at all sides.
    """
    notes = []
    for axis in range(3):
        counts = np.count_nonzero(tags, axis=tuple({0, 1, 2} - {axis}))
        low = image.corner[axis]
        counts = np.pad(counts, (low, image.shape[axis] - low - len(counts)))
        for high, slices in ((False, counts), (True, counts[::-1])):
            if slices[0] > TAPER * slices[1:2].sum():
                area_cm2 = slices[0] * float(np.prod(np.delete(image.geometry.spacing, axis))) * 1e4
                notes.append(
                    f"the organ touches the image's border towards the {image.geometry.side(axis, high=high)} with a "
                    f"flat face of {area_cm2:.3g} cm^2: it is cut off there, unless that is its shape"
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
    label, count = parts_of(chosen, corners=True) if split else (chosen.view(np.uint8), 1)
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
