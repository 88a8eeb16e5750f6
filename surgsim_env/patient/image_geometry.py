"""Where the voxels of an image lie in the patient: spacing, directions and origin, in LPS metres."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msdm_core.errors import MeshError
from msdm_core.mesh import FloatArray

CONVENTION = "x to the patient's left, y to the back, z to the head (LPS, as DICOM), metres, the scanner's own origin"
# Cosine of the angle between two axes of voxels above which they are not at right angles; headers hold 32-bit numbers.
COSINE_LARGEST = 1e-3
# Spacings of voxels that an organ's image has [m].
SPACING_RANGE = (1e-5, 0.05)
AXES = (("right", "left"), ("front", "back"), ("feet", "head"))


@dataclass(frozen=True, eq=False)
class ImageGeometry:
    """Place of voxel (i, j, k) in LPS: origin + direction @ (spacing * (i, j, k)).

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
        """The geometry of a header's matrix, one step along each axis as columns (3, 3) [m], and origin (3,) [m], LPS.

        Raises:
            MeshError: names the file and what is not finite, not at right angles, or no likely spacing.
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
        # The nearest orthogonal matrix: what is left is the header's rounding.
        left, _, right = np.linalg.svd(direction)
        return cls(spacing, left @ right, np.asarray(origin, dtype=np.float64))

    def moved(self, corner: FloatArray) -> "ImageGeometry":
        """That of a part of the image which begins at voxel `corner` (3,)."""
        return ImageGeometry(self.spacing, self.direction, self.places(np.asarray(corner) * self.spacing))

    def places(self, points: FloatArray) -> FloatArray:
        """Points [m] along the image's axes from the centre of voxel (0, 0, 0), in LPS, shape (..., 3)."""
        return self.origin + points @ self.direction.T

    def side(self, axis: int, *, high: bool) -> str:
        """The patient's side to which an axis of the image begins or ends, such as "head"."""
        along = self.direction[:, axis]
        main = int(np.argmax(np.abs(along)))
        return AXES[main][int((along[main] > 0) == high)]
