"""Label images that tests make and know again: an ellipsoid of an organ with two lesions, as a CT's would be."""

from pathlib import Path

import nibabel
import numpy as np

# Half axes along x, y, z of LPS, and of the lesions the centre and radius [mm].
AXES = np.array([45.0, 36.0, 30.0])
LESIONS = ((np.array([18.0, -17.0, 8.0]), 9.0), (np.array([-16.0, -14.0, 12.0]), 7.5))
# The organ's middle in the patient, LPS [mm].
MIDDLE = np.array([-60.0, 25.0, 110.0])
ORGAN_VOLUME = 4.0 / 3.0 * np.pi * np.prod(AXES) * 1e-9  # [m^3]
# What the command line calls them.
LABELS = ("--labels", "liver=1,lesion=2")


def labels_on(affine: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """1 in the organ, 2 in its lesions, at the voxels of a RAS affine [mm] (4, 4)."""
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    ras = index @ affine[:3, :3].T + affine[:3, 3]
    place = ras * [-1.0, -1.0, 1.0] - MIDDLE
    labels = ((place / AXES) ** 2).sum(axis=-1) <= 1.0
    lesions = [((place - centre) ** 2).sum(axis=-1) <= radius**2 for centre, radius in LESIONS]
    return np.where(labels & np.any(lesions, axis=0), 2, labels).astype(np.uint8)


def affine_of(spacing=(2.0, 2.0, 2.0), turn: np.ndarray | None = None, margin: float = 6.0):
    """A RAS affine [mm] and a shape whose box holds the organ with a margin [mm]."""
    turn = np.eye(3) if turn is None else turn
    matrix = turn * np.asarray(spacing)
    reach = np.abs(turn.T) @ AXES + margin
    shape = tuple(int(n) for n in np.ceil(2.0 * reach / np.asarray(spacing)))
    affine = np.eye(4)
    affine[:3, :3] = matrix
    affine[:3, 3] = MIDDLE * [-1.0, -1.0, 1.0] - matrix @ ((np.array(shape) - 1) / 2)
    return affine, shape


def write_nifti(path: Path, labels: np.ndarray, affine: np.ndarray, *, unit: str = "mm") -> Path:
    """A NIfTI file of labels; `affine` is in the unit."""
    image = nibabel.Nifti1Image(labels, affine)
    image.header.set_xyzt_units(unit)
    nibabel.save(image, path)
    return path


def scan(path: Path, **geometry) -> Path:
    """The organ as a NIfTI file."""
    affine, shape = affine_of(**geometry)
    return write_nifti(path, labels_on(affine, shape), affine)


def _places(image, tag):
    """LPS places of a tag's voxels [mm], (n, 3)."""
    return 1e3 * image.geometry.places(np.argwhere(image.tags == tag) * image.geometry.spacing)


def check_organ(image, spacing):
    """The organ lies where it is in the patient, whatever the image's axes."""
    both = np.concatenate([_places(image, 1), _places(image, 2)])
    # Means over some thousand voxels, extents to two voxels.
    np.testing.assert_allclose(both.mean(axis=0), MIDDLE, atol=0.3)
    np.testing.assert_allclose(np.ptp(both, axis=0), 2 * AXES, atol=2 * max(spacing))
    lesions = _places(image, 2).mean(axis=0) - MIDDLE
    # Both lesions lie to the front and the head, the larger to the left.
    assert lesions[0] > 2.0
    assert lesions[1] < -12.0
    assert lesions[2] > 6.0


def border_notes(notes) -> list[str]:
    """The notes on an organ that ends with its image."""
    return [note for note in notes if "border" in note]


# A wedge as a liver's edge is one: half its width along x, its length up from its edge along z, how thick that is and
# how it grows [mm], LPS.
WEDGE_HALF, WEDGE_LENGTH, WEDGE_EDGE, WEDGE_SLOPE = 48.0, 92.0, 5.0, 0.40
# The middle of its lesion, and that's radius [mm].
WEDGE_LESION, WEDGE_LESION_RADIUS = np.array([20.0, -14.0, 66.0]), 9.0


def wedge(path: Path, spacing: float = 1.5) -> Path:
    """A wedge with its level side to the back, its edge to the feet, a lesion near its thick end."""
    x, y, z = (np.arange(low, high, spacing) for low, high in ((-54.0, 54.0), (-54.0, 9.0), (-9.0, 99.0)))
    place = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
    aside, depth, height = np.abs(place[..., 0]), place[..., 2], -place[..., 1]
    thickness = WEDGE_EDGE + WEDGE_SLOPE * depth
    inside = (aside <= WEDGE_HALF) & (depth >= 0.0) & (depth <= WEDGE_LENGTH) & (height >= 0.0) & (height <= thickness)
    ill = inside & (((place - WEDGE_LESION) ** 2).sum(axis=-1) <= WEDGE_LESION_RADIUS**2)
    affine = np.diag([-spacing, -spacing, spacing, 1.0])
    affine[:3, 3] = -x[0], -y[0], z[0]
    return write_nifti(path, np.where(ill, 2, inside).astype(np.uint8), affine)


# A spleen as a cap: half its width and length across its crown and half its thickness, how far its rim bends back, and
# the direction of its crown, to the patient's left and the front [mm], LPS.
SPLEEN_AXES, SPLEEN_BEND = np.array([36.0, 54.0, 22.0]), 12.0
SPLEEN_CROWN = np.array([0.8, -0.6, 0.0])
# Its lesions: across the crown and along its length, below the mid surface's height, radius [mm].
SPLEEN_LESIONS = ((np.array([2.0, 22.0, 6.0]), 10.0), (np.array([-4.0, -20.0, 6.0]), 10.0))


def spleen(path: Path, spacing: float = 2.0) -> Path:
    """A cap, convex to the left and front, hollow towards the spine, with two lesions below its crown."""
    line = np.arange(-66.0, 66.0, spacing)
    place = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
    up = np.array([0.0, 0.0, 1.0])
    across = np.stack([place @ np.cross(SPLEEN_CROWN, up), place @ up, place @ SPLEEN_CROWN], axis=-1)
    across[..., 2] += SPLEEN_BEND * ((across[..., :2] / SPLEEN_AXES[:2]) ** 2).sum(axis=-1)
    inside = ((across / SPLEEN_AXES) ** 2).sum(axis=-1) <= 1.0
    ill = [((across - centre) ** 2).sum(axis=-1) <= radius**2 for centre, radius in SPLEEN_LESIONS]
    affine = np.diag([-spacing, -spacing, spacing, 1.0])
    affine[:3, 3] = -line[0], -line[0], line[0]
    return write_nifti(path, np.where(inside & np.any(ill, axis=0), 2, inside).astype(np.uint8), affine)
