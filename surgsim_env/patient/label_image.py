"""The chosen labels of a scan, cropped to their bounding box, with their geometry in the patient."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from surgsim_env.patient.dicom_segmentation import open_segmentation
from surgsim_env.patient.itk_labels import open_itk
from surgsim_env.patient.label_source import ImageGeometry, LabelSource, checked_whole
from surgsim_env.patient.materials import check_name
from surgsim_env.patient.nifti_labels import open_nifti

IMAGE_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".mha", ".dcm")
# Largest bounding box of the labels [voxels]; meshing makes a few copies of it with four bytes a voxel.
BOX_VOXELS_MOST = 200_000_000
LABEL_LARGEST = 2**31 - 1
LABELS_MOST = 32
FORM = "--labels NAME=LABEL,... with the organ first, such as liver=1,lesion=2"


@dataclass(frozen=True)
class LabelName:
    """A tissue's name and its label in the image."""

    name: str
    value: int


def parse_labels(text: str) -> tuple[LabelName, ...]:
    """The tissues of a text such as "liver=1,lesion=2", the organ first.

    Raises:
        MeshError: a part that breaks the form, a name or a label given twice, too many labels.
    """
    names = []
    for part in text.split(","):
        name, found, value = part.partition("=")
        name = name.strip()
        if not found or not re.fullmatch(r"\s*\d{1,10}\s*", value):
            raise MeshError(f"--labels: {part!r} is no NAME=LABEL; give {FORM}")
        if not 1 <= int(value) <= LABEL_LARGEST:
            raise MeshError(f"--labels: {part!r}: labels are from 1 to {LABEL_LARGEST}, 0 is outside; give {FORM}")
        names.append(LabelName(check_name(name, "--labels"), int(value)))
    for what in ("name", "value"):
        given = [getattr(one, what) for one in names]
        twice = next((one for one in given if given.count(one) > 1), None)
        if twice is not None:
            raise MeshError(f"--labels: {twice!r} is given twice; each tissue has one label of its own")
    if len(names) > LABELS_MOST:
        raise MeshError(f"--labels: {len(names)} labels are given; at most {LABELS_MOST} are taken")
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
        """[m^3]."""
        return float(np.prod(self.geometry.spacing))


def is_image(file: Path) -> bool:
    """Whether a file has an extension of label images."""
    return file.name.lower().endswith(IMAGE_SUFFIXES)


def read_label_image(file: Path, labels: Sequence[LabelName]) -> LabelImage:
    """Read the named labels of an image file; needs one byte a voxel and a few runs of memory.

    Raises:
        MeshError: a file that is missing, cut short, wrongly compressed, sheared, too large or not of three axes;
            values that are not whole numbers; a label that is nowhere in it (lists those that are).
    """
    source = _source(file, [label.value for label in labels])
    found = np.zeros(source.shape, dtype=np.uint8, order="F")
    counts = np.zeros(len(labels) + 1, dtype=np.int64)
    # A view of `found`, which is stored in this order.
    line = found.reshape(-1, order="F")
    for first, values in source.runs():
        whole = checked_whole(values, file)
        part = line[first : first + len(whole)]
        for tag, label in enumerate(labels, start=1):
            chosen = whole == label.value
            count = int(np.count_nonzero(chosen))
            # Pages of `found` that are never written to take no memory.
            if count:
                counts[tag] += count
                part[chosen] = tag
    for tag, label in enumerate(labels, start=1):
        if not counts[tag]:
            raise MeshError(
                f"{file}: label {label.value} ({label.name!r}) is nowhere in the image; there are {_there(source)}: "
                "correct --labels"
            )
    return _cut(found, labels, source)


def _source(file: Path, wanted: Sequence[int]) -> LabelSource:
    if file.is_dir():
        raise MeshError(f"{file}: is a directory; give the path of a file in it")
    if not file.is_file():
        raise MeshError(f"{file}: no such file; check the path (current folder: {Path.cwd()})")
    if not file.stat().st_size:
        raise MeshError(f"{file}: is empty (0 bytes); export it again")
    if file.name.lower().endswith((".nii", ".nii.gz")):
        return open_nifti(file)
    segmentation = open_segmentation(file, wanted) if file.suffix.lower() == ".dcm" else None
    return segmentation or open_itk(file)


def _there(source: LabelSource) -> str:
    values: set[int] = set()
    for _, run in source.runs():
        values |= set(np.unique(run)[:100].astype(np.int64).tolist())
    values.discard(0)
    known = sorted(values)
    more = ", ..." if len(known) > 20 else ""
    return f"labels {', '.join(map(str, known[:20]))}{more}" if known else "no labels at all, every voxel is 0"


def _cut(found: NDArray[np.uint8], labels: Sequence[LabelName], source: LabelSource) -> LabelImage:
    box = []
    for axis in range(3):
        used = np.flatnonzero(found.any(axis=tuple({0, 1, 2} - {axis})))
        box.append(slice(int(used[0]), int(used[-1]) + 1))
    sides = [one.stop - one.start for one in box]
    total = float(np.prod(np.array(sides, dtype=np.float64)))
    if total > BOX_VOXELS_MOST:
        raise MeshError(
            f"{source.file}: the labels reach over {' x '.join(map(str, sides))} = {total:.3g} voxels; at most "
            f"{BOX_VOXELS_MOST:.3g} are worked on: resample the image, voxels of a tenth of a cell are fine enough"
        )
    x, y, z = (one.start for one in box)
    return LabelImage(
        np.ascontiguousarray(found[tuple(box)]),
        tuple(label.name for label in labels),
        source.geometry.moved(np.array([x, y, z], dtype=np.float64)),
        (x, y, z),
        source.shape,
        source.notes,
    )
