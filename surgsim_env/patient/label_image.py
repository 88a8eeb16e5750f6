"""The labels of interest of a scan, cut to their box, with their place in the patient."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from surgsim_env.patient.image_geometry import ImageGeometry
from surgsim_env.patient.label_names import LabelName

IMAGE_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".mha", ".dcm")
# One byte each is held while an image is read.
VOXELS_MOST = 1_000_000_000
# So many are looked at together, of which some copies of eight bytes are made.
RUN_VOXELS = 2_000_000
# Of the labels' box, of which some copies of four bytes are made.
BOX_VOXELS_MOST = 200_000_000


@dataclass(frozen=True, eq=False)
class LabelImage:
    """Part of a label image.

    Fields:
        tags: n for the n-th of `names`, counted from 1, 0 outside       (n_x, n_y, n_z) uint8
        names: of the tissues, the organ first
        geometry: of this part
        corner: its first voxel in the whole image                       (3,)
        shape: of the whole image
        notes: what a reader should know of the file
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


@dataclass(frozen=True, eq=False)
class LabelSource:
    """An image file that was looked into: its shape, geometry, and its voxels in runs, read anew each time.

    `runs` gives (first voxel, values (n,)) in order, the first axis running fastest.
    """

    file: Path
    shape: tuple[int, int, int]
    geometry: ImageGeometry
    runs: Callable[[], Iterator[tuple[int, NDArray]]]
    notes: tuple[str, ...] = ()


def is_image(file: Path) -> bool:
    """Whether a file's name is that of an image."""
    return file.name.lower().endswith(IMAGE_SUFFIXES)


def read_label_image(file: Path, labels: Sequence[LabelName]) -> LabelImage:
    """The named labels of an image file, in memory of a byte a voxel and some of RUN_VOXELS.

    Raises:
        MeshError: names the file and what is wrong: missing, cut short, wrongly compressed, not three axes, sheared,
            too large, numbers that are not whole, a label that is nowhere in it (says which are).
    """
    source = _source(file, [label.value for label in labels])
    found = np.zeros(source.shape, dtype=np.uint8, order="F")
    counts = np.zeros(len(labels) + 1, dtype=np.int64)
    # A view, as `found` lies in this order.
    line = found.reshape(-1, order="F")
    for first, values in source.runs():
        whole = checked_whole(values, file)
        part = line[first : first + len(whole)]
        for tag, label in enumerate(labels, start=1):
            chosen = whole == label.value
            count = int(np.count_nonzero(chosen))
            # Runs without labels are not written to: their memory is then never taken.
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


def checked_shape(shape: Sequence[int], file: Path) -> tuple[int, int, int]:
    """Three counts of voxels of a header; further axes of length 1 are left out.

    Raises:
        MeshError: fewer or more axes, or an image that is too large.
    """
    counts = [int(count) for count in shape]
    while len(counts) > 3 and counts[-1] == 1:
        counts.pop()
    if len(counts) != 3:
        text = " x ".join(map(str, counts))
        raise MeshError(
            f"{file}: the image has {len(counts)} axes ({text}); the rule is three: export one volume of it"
        )
    if min(counts) < 1:
        raise MeshError(f"{file}: the image has {' x '.join(map(str, counts))} voxels: export it again")
    total = counts[0] * counts[1] * counts[2]
    if total > VOXELS_MOST:
        raise MeshError(
            f"{file}: the image has {' x '.join(map(str, counts))} = {total:.3g} voxels; at most {VOXELS_MOST:.3g} are "
            "read: crop it to the organ, or resample it"
        )
    return counts[0], counts[1], counts[2]


def checked_kind(dtype: np.dtype, file: Path) -> None:
    """Refuse values such as colours or complex numbers; MeshError names their type."""
    if dtype.kind not in "iubf":
        raise MeshError(f"{file}: the image's values are {dtype}; labels are whole numbers: export a label map")


def checked_whole(values: NDArray, file: Path) -> NDArray:
    """Label values; MeshError names the first that is not a whole number."""
    checked_kind(values.dtype, file)
    if values.dtype.kind != "f":
        return values
    wrong = values != np.rint(values)
    if wrong.any():
        raise MeshError(
            f"{file}: the image holds {float(values[wrong][0]):g}, which is no whole number: labels are; is this the "
            "scan itself, or resampled with interpolation? Export a label map, resampled by nearest neighbours"
        )
    return values


def _source(file: Path, wanted: Sequence[int]) -> LabelSource:
    from surgsim_env.patient.dicom_segmentation import open_segmentation
    from surgsim_env.patient.itk_labels import open_itk
    from surgsim_env.patient.nifti_labels import open_nifti

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
