"""The result of every reader of label images: shape, geometry in the patient, and voxels in runs; checks of headers."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh.tet_mesh import FloatArray

# The axes of a scan's mesh, in words.
CONVENTION = "x to the patient's left, y to the back, z to the head (LPS, as DICOM), metres, the scanner's own origin"
# Two axes are at right angles up to this cosine of the angle between them; headers hold 32-bit numbers.
COSINE_LARGEST = 1e-3
# Smallest and largest voxel spacing that is accepted [m].
SPACING_RANGE = (1e-5, 0.05)
AXES = (("right", "left"), ("front", "back"), ("feet", "head"))
# Largest image [voxels]; a reader holds one byte of each.
VOXELS_MOST = 1_000_000_000
# Length of a run [voxels]; a reader makes a few copies of it with eight bytes a voxel.
RUN_VOXELS = 2_000_000


@dataclass(frozen=True, eq=False)
class ImageGeometry:
    """Position of voxel (i, j, k) in LPS: origin + direction @ (spacing * (i, j, k)).

    Fields:
        spacing: of voxels along the image's axes [m]           (3,)
        direction: unit vectors of these axes, as columns       (3, 3)
        origin: centre of voxel (0, 0, 0) [m]                   (3,)
    """

    spacing: FloatArray
    direction: FloatArray
    origin: FloatArray

    @classmethod
    def from_matrix(cls, matrix: FloatArray, origin: FloatArray, file: Path) -> "ImageGeometry":
        """The geometry of a header.

        Args:
            matrix: the step from voxel to voxel along each axis of the image, as columns, LPS (3, 3) [m].
            origin: centre of the first voxel, LPS (3,) [m].
            file: for messages.

        Raises:
            MeshError: numbers that are not finite, axes that are not at right angles, a spacing outside SPACING_RANGE.
        """
        if not (np.isfinite(matrix).all() and np.isfinite(origin).all()):
            raise MeshError(f"{file}: the header's affine has numbers that are not finite: export the image again")
        spacing = np.linalg.norm(matrix, axis=0)
        low, high = SPACING_RANGE
        if not ((spacing >= low) & (spacing <= high)).all():
            shown = " x ".join(f"{one * 1e3:.4g}" for one in spacing)
            raise MeshError(
                f"{file}: the header's voxels are {shown} mm; the rule is {low * 1e3:g} to {high * 1e3:g} mm a side: "
                "is the header's length unit right?"
            )
        direction = matrix / spacing
        cosines = np.abs(direction.T @ direction - np.eye(3))
        if cosines.max() > COSINE_LARGEST:
            first, second = np.unravel_index(int(np.argmax(cosines)), (3, 3))
            angle = np.degrees(np.arccos(np.clip(direction[:, first] @ direction[:, second], -1, 1)))
            raise MeshError(
                f"{file}: axes {first} and {second} of the header's affine stand at {angle:.2f} degrees; sheared "
                "images (non-orthogonal affine, as of a tilted gantry) are refused: resample it onto right-angled axes"
            )
        # The nearest orthogonal matrix removes the header's rounding.
        left, _, right = np.linalg.svd(direction)
        return cls(spacing, left @ right, np.asarray(origin, dtype=np.float64))

    def moved(self, corner: FloatArray) -> "ImageGeometry":
        """The geometry of a part of the image that begins at voxel `corner` (3,)."""
        return ImageGeometry(self.spacing, self.direction, self.places(np.asarray(corner) * self.spacing))

    def places(self, points: FloatArray) -> FloatArray:
        """LPS positions (..., 3) [m] of points given along the image's axes from voxel (0, 0, 0), (..., 3) [m]."""
        return self.origin + points @ self.direction.T

    def side(self, axis: int, *, high: bool) -> str:
        """The patient's side to which an axis of the image begins or ends, such as "head"."""
        along = self.direction[:, axis]
        main = int(np.argmax(np.abs(along)))
        return AXES[main][int((along[main] > 0) == high)]


@dataclass(frozen=True, eq=False)
class LabelSource:
    """An image file whose header was read.

    Fields:
        file: its path
        shape: of the image                                     (3,)
        geometry: spacing, directions and origin
        runs: reads the voxels as (first voxel, values (n,)), in order, the first axis fastest
        notes: assumptions about the header, for the report
    """

    file: Path
    shape: tuple[int, int, int]
    geometry: ImageGeometry
    runs: Callable[[], Iterator[tuple[int, NDArray]]]
    notes: tuple[str, ...] = ()


def checked_shape(shape: Sequence[int], file: Path) -> tuple[int, int, int]:
    """The three voxel counts of a header; further axes of length 1 are dropped.

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
    """Raise a MeshError for values such as colours or complex numbers."""
    if dtype.kind not in "iubf":
        raise MeshError(f"{file}: the image's values are {dtype}; labels are whole numbers: export a label map")


def checked_whole(values: NDArray, file: Path) -> NDArray:
    """The label values; raises a MeshError with the first that is not a whole number."""
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
