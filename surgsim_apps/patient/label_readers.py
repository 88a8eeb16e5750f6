"""Readers of label images in NIfTI, NRRD, MetaImage and DICOM: geometry in the patient, and voxels."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import arccos, matmul, norm, svd
from msdm_core.errors import MeshError
from msdm_core.mesh import FloatArray
from msdm_core.mesh_files import parsed

# The axes of a scan's mesh, in words.
CONVENTION = "x to the patient's left, y to the back, z to the head (LPS, as DICOM), metres, the scanner's own origin"
# Largest cosine of the angle between two axes at right angles; headers hold 32-bit numbers.
COSINE_LARGEST = 1e-3
# Smallest and largest accepted voxel spacing [m].
SPACING_RANGE = (1e-5, 0.05)
AXES = (("right", "left"), ("front", "back"), ("feet", "head"))
# NIfTI's axes are RAS: x to the right and y to the front.
RAS_TO_LPS = np.diag([-1.0, -1.0, 1.0])
METRES = {"meter": 1.0, "mm": 1e-3, "micron": 1e-6}
# Segmentation Storage and Label Map Segmentation Storage (DICOM PS3.4, B.5).
CLASSES = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")
# Largest distance of frames off the grid, over the slice step, or over 1 mm for thinner slices.
SLACK = 0.02


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
        """Geometry of a header.

        Args:
            matrix: the step from voxel to voxel along each axis of the image, as columns, LPS (3, 3) [m].
            origin: centre of the first voxel, LPS (3,) [m].
            file: for messages.

        Raises:
            MeshError: axes that are not at right angles, a spacing outside SPACING_RANGE.
        """
        spacing = norm(matrix, axis=0)
        low, high = SPACING_RANGE
        if not ((spacing >= low) & (spacing <= high)).all():
            shown = " x ".join(f"{length * 1e3:.4g}" for length in spacing)
            raise MeshError(
                f"{file}: the header's voxels are {shown} mm; the rule is {low * 1e3:g} to {high * 1e3:g} mm a side: "
                "is the header's length unit right?"
            )
        direction = matrix / spacing
        cosines = np.abs(matmul(direction.T, direction) - np.eye(3))
        if cosines.max() > COSINE_LARGEST:
            first, second = np.unravel_index(int(np.argmax(cosines)), (3, 3))
            angle = np.degrees(arccos(np.clip(matmul(direction[:, first], direction[:, second]), -1, 1)))
            raise MeshError(
                f"{file}: axes {first} and {second} of the header's affine stand at {angle:.2f} degrees; sheared "
                "images (non-orthogonal affine, as of a tilted gantry) are refused: resample it onto right-angled axes"
            )
        # The nearest orthogonal matrix removes the header's rounding.
        left, _, right = svd(direction)
        return cls(spacing, matmul(left, right), np.asarray(origin, dtype=np.float64))

    def moved(self, corner: FloatArray) -> "ImageGeometry":
        """Geometry of a part of the image from voxel `corner` (3,) on."""
        return ImageGeometry(self.spacing, self.direction, self.places(np.asarray(corner) * self.spacing))

    def places(self, points: FloatArray) -> FloatArray:
        """LPS positions (..., 3) [m] of points along the image's axes from voxel (0, 0, 0), (..., 3) [m]."""
        return self.origin + matmul(points, self.direction.T)

    def side(self, axis: int, *, high: bool) -> str:
        """Side of the patient at the beginning or end of an axis, such as "head"."""
        along = self.direction[:, axis]
        main = int(np.argmax(np.abs(along)))
        return AXES[main][int((along[main] > 0) == high)]


@dataclass(frozen=True, eq=False)
class LabelSource:
    """Contents of an image file.

    Fields:
        file: its path
        values: of its voxels                                   (n_x, n_y, n_z)
        geometry: spacing, directions and origin
        notes: assumptions about the header, for the report
    """

    file: Path
    values: NDArray
    geometry: ImageGeometry
    notes: tuple[str, ...] = ()


def read_labels(file: Path, wanted: Sequence[int]) -> LabelSource:
    """Read an image file by its suffix.

    Args:
        file: the file.
        wanted: segment numbers of a DICOM segmentation; of overlapping segments the later in this list applies.

    Raises:
        MeshError: an unreadable file, an image that is sheared or not of three axes, voxels that are no whole numbers.
    """
    return parsed(file, lambda _: _read(file, wanted), "export or copy it again")


def _read(file: Path, wanted: Sequence[int]) -> LabelSource:
    try:
        if file.name.lower().endswith((".nii", ".nii.gz")):
            source = _read_nifti(file)
        else:
            segmentation = _read_segmentation(file, wanted) if file.suffix.lower() == ".dcm" else None
            source = segmentation or _read_itk(file)
    except ImportError as error:
        raise MeshError(f"{file}: reading it needs {error.name}: pip install 'surgsim[patient]'") from None
    check_whole(source.values, file)
    return source


def checked_shape(shape: Sequence[int], file: Path) -> tuple[int, int, int]:
    """Voxel counts of a header's three axes; further axes of length 1 are dropped.

    Raises:
        MeshError: fewer or more axes.
    """
    counts = [int(count) for count in shape]
    while len(counts) > 3 and counts[-1] == 1:
        counts.pop()
    if len(counts) != 3:
        text = " x ".join(map(str, counts))
        raise MeshError(
            f"{file}: the image has {len(counts)} axes ({text}); the rule is three: export one volume of it"
        )
    return counts[0], counts[1], counts[2]


def check_whole(values: NDArray, file: Path) -> None:
    """Refuse values that are no whole numbers."""
    if values.dtype.kind not in "iubf":
        raise MeshError(f"{file}: the image's values are {values.dtype}; labels are whole numbers: export a label map")
    if values.dtype.kind != "f":
        return
    # numpy warns of signalling NaNs; all are wrong here.
    with np.errstate(invalid="ignore"):
        wrong = (values != np.rint(values)) | ~np.isfinite(values)
    if wrong.any():
        raise MeshError(
            f"{file}: the image holds {float(values[wrong][0]):g}, which is no whole number: labels are; is this the "
            "scan itself, or resampled with interpolation? Export a label map, resampled by nearest neighbours"
        )


def _read_nifti(file: Path) -> LabelSource:
    import nibabel

    image: Any = nibabel.load(file)
    header, notes = image.header, []
    shape = checked_shape(image.shape, file)
    unit = str(header.get_xyzt_units()[0])
    if unit not in METRES:
        notes.append("the header states no length unit: millimetres are assumed, as NIfTI's readers do")
    if not int(header["sform_code"]) and not int(header["qform_code"]):
        notes.append("the header states no orientation: left and right, front and back may be swapped")
    matrix, origin = np.hsplit(matmul(RAS_TO_LPS, image.affine[:3] * METRES.get(unit, 1e-3)), [3])
    geometry = ImageGeometry.from_matrix(matrix, origin[:, 0], file)
    return LabelSource(file, np.asanyarray(image.dataobj).reshape(shape), geometry, tuple(notes))


def _read_itk(file: Path) -> LabelSource:
    """Read an NRRD, MetaImage or DICOM image."""
    import SimpleITK

    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)
    reader: Any = SimpleITK.ImageFileReader()
    reader.SetFileName(str(file))
    reader.ReadImageInformation()
    shape = checked_shape(reader.GetSize(), file)
    components = reader.GetNumberOfComponents()
    if components != 1:
        raise MeshError(f"{file}: each voxel has {components} numbers; the rule is one label: export one layer of it")
    dimension = reader.GetDimension()
    direction = np.array(reader.GetDirection()).reshape(dimension, dimension)[:3, :3]
    matrix = direction * np.array(reader.GetSpacing()[:3]) * 1e-3
    geometry = ImageGeometry.from_matrix(matrix, np.array(reader.GetOrigin()[:3]) * 1e-3, file)
    notes: tuple[str, ...] = ()
    if file.suffix.lower() == ".nrrd" and not reader.HasMetaDataKey("NRRD_space"):
        notes = ("the header names no anatomical space: left, back and up (LPS) are assumed",)
    # SimpleITK's arrays have the axes reversed.
    return LabelSource(file, SimpleITK.GetArrayFromImage(reader.Execute()).T.reshape(shape), geometry, notes)


def _read_segmentation(file: Path, wanted: Sequence[int]) -> LabelSource | None:
    """Read a DICOM segmentation; None for another DICOM file."""
    import pydicom

    data: Any = pydicom.dcmread(file)
    if str(data.get("SOPClassUID", "")) not in CLASSES:
        return None
    kind = str(data.SegmentationType)
    if kind not in ("BINARY", "LABELMAP"):
        raise MeshError(f"{file}: its segments are {kind:.80}; the rule is BINARY or LABELMAP: export it so")
    segments = {int(segment.SegmentNumber): str(segment.SegmentLabel) for segment in data.SegmentSequence}
    missing = [number for number in wanted if number not in segments]
    if missing:
        there = ", ".join(f"{number} ({name!r})" for number, name in sorted(segments.items())[:20])
        raise MeshError(f"{file}: segment {missing[0]} is nowhere in it; there are {there}: correct --labels")
    frames = list(data.PerFrameFunctionalGroupsSequence)
    rows, columns = int(data.Rows), int(data.Columns)
    geometry, slices = _geometry(file, data, frames)
    values = np.zeros(checked_shape((columns, rows, int(slices.max()) + 1), file), dtype=np.int32)
    pixels = np.atleast_3d(data.pixel_array).reshape(len(frames), rows, columns)
    if kind == "LABELMAP":
        for frame, place in enumerate(slices):
            values[..., place] = pixels[frame].T
        return LabelSource(file, values, geometry)
    groups = [_group(data, frame, "SegmentIdentificationSequence") for frame in frames]
    numbers = np.array([int(group.ReferencedSegmentNumber) for group in groups])
    for number in wanted:
        for frame in np.flatnonzero(numbers == number):
            values[pixels[frame].T > 0, slices[frame]] = number
    return LabelSource(file, values, geometry)


def _group(data: Any, frame: Any, name: str) -> Any:
    """First item of a functional group: the frame's own, else that of all frames."""
    return (frame if name in frame else data.SharedFunctionalGroupsSequence[0])[name][0]


def _geometry(file: Path, data: Any, frames: Sequence[Any]) -> tuple[ImageGeometry, NDArray[np.int64]]:
    """Geometry of the stack, and slice of each frame (n_frame,)."""
    planes = [_group(data, frame, "PlaneOrientationSequence") for frame in frames]
    turns = {tuple(map(float, plane.ImageOrientationPatient)) for plane in planes}
    measures = _group(data, frames[0], "PixelMeasuresSequence")
    if len(turns) != 1:
        raise MeshError(
            f"{file}: its frames have {len(turns)} orientations; the rule is one stack of parallel slices: resample it"
        )
    turn = np.array(turns.pop()).reshape(2, 3)
    normal = np.cross(turn[0], turn[1])
    positions = [_group(data, frame, "PlanePositionSequence") for frame in frames]
    places = np.array([position.ImagePositionPatient for position in positions], dtype=float)
    along = matmul(places, normal)
    step = _slice_step(file, along, measures)
    slices = np.rint((along - along.min()) / step).astype(np.int64)
    first = places[int(np.argmin(along))]
    off = norm(places - first - slices[:, None] * step * normal, axis=1)
    if off.max() > SLACK * max(step, 1.0):
        raise MeshError(
            f"{file}: a frame lies {off.max():.3g} mm off an even stack of {step:.4g} mm slices: sheared or uneven "
            "stacks are refused: resample it onto right-angled axes"
        )
    row_spacing, column_spacing = map(float, measures.PixelSpacing)
    matrix: FloatArray = np.column_stack([turn[0] * column_spacing, turn[1] * row_spacing, normal * step]) * 1e-3
    return ImageGeometry.from_matrix(matrix, first * 1e-3, file), slices


def _slice_step(file: Path, along: FloatArray, measures: Any) -> float:
    """Distance between slices [mm] by the frames' positions along the normal [mm]; of a single slice as stated."""
    apart = np.diff(np.unique(np.round(along, 3)))
    if len(apart):
        # The mean over the stack is free of the positions' rounding.
        return float(np.ptp(along) / max(round(np.ptp(along) / apart.min()), 1))
    stated = measures.get("SpacingBetweenSlices") or measures.get("SliceThickness")
    if stated is None:
        raise MeshError(f"{file}: has one slice and states no thickness: export it with SliceThickness")
    return float(stated)
