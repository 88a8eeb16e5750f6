"""Readers of label images in NIfTI, NRRD, MetaImage and DICOM: geometry in the patient, and voxels."""

import contextlib
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

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
NRRD_SUFFIXES = (".nrrd", ".nhdr")
METRES = {"meter": 1.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "micron": 1e-6, "um": 1e-6}
# Segmentation Storage and Label Map Segmentation Storage (DICOM PS3.4, B.5).
CLASSES = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")
# Largest distance of frames off the grid, over the slice step, or over 1 mm for thinner slices; and largest difference
# of two statements of a header about one length, over the voxels' spacing.
SLACK = 0.02
# Largest distance of labels in floats from whole numbers, and largest relative difference of pixels: rounding. Large
# labels are off by a share of their own.
ROUNDING, ROUNDING_SHARE = 1e-3, 1e-6


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
            MeshError: axes that are not at right angles, a spacing outside SPACING_RANGE, an origin that is not finite.
        """
        spacing = norm(matrix, axis=0)
        low, high = SPACING_RANGE
        if not ((spacing >= low) & (spacing <= high)).all():
            raise MeshError(
                f"{file}: the header's voxels are {sides_text(spacing)}; the rule is {low * 1e3:g} to {high * 1e3:g} "
                "mm a side: is the header's length unit right?"
            )
        if not np.isfinite(origin).all():
            raise MeshError(
                f"{file}: the header's origin is {origin}; the rule is three finite numbers: export it again"
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

    @property
    def affine(self) -> FloatArray:
        """Matrix from (i, j, k, 1) to the voxel's position (3, 4) [m]."""
        return np.column_stack([self.direction * self.spacing, self.origin])

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


def sides_text(spacing: FloatArray) -> str:
    """Sides of a voxel (3,) [m] in words."""
    return f"{' x '.join(f'{length * 1e3:.4g}' for length in spacing)} mm"


def farthest_corner(first: FloatArray, other: FloatArray, shape: Sequence[int]) -> float:
    """Largest distance between an image's corner voxels as placed by two affines, in the unit of both."""
    corners = np.array(list(product(*((0, count - 1) for count in shape), (1,))), dtype=np.float64)
    return float(norm(matmul(corners, (other - first).T), axis=1).max())


@dataclass(frozen=True)
class Segment:
    """Label of a file.

    Fields:
        value: of its voxels; of a DICOM segmentation the segment's number
        names: in the file, that for messages first
        layer: of its voxels, in an image of several layers
    """

    value: int
    names: tuple[str, ...] = ()
    layer: int | None = None

    def __str__(self) -> str:
        """The label in one line."""
        name = " ".join(self.names[0].split())[:40] if self.names else ""
        if self.layer is not None:
            return f"{name or 'nameless'}: layer {self.layer}, value {self.value}"
        return f"{self.value} ({name})" if name else f"{self.value}"


@dataclass(frozen=True, eq=False)
class LabelSource:
    """Contents of an image file.

    Fields:
        file: its path
        shape: its voxel counts                                 (3,)
        geometry: spacing, directions and origin
        segments: the labels that voxels have
        mask: true at a label's voxels                          (n_x, n_y, n_z)
        notes: assumptions about the header and the values, for the report
    """

    file: Path
    shape: tuple[int, int, int]
    geometry: ImageGeometry
    segments: tuple[Segment, ...]
    mask: Callable[[Segment], NDArray[np.bool_]]
    notes: tuple[str, ...] = ()

    @classmethod
    def from_values(
        cls,
        file: Path,
        values: NDArray,
        geometry: ImageGeometry,
        stated: Iterable[Segment] = (),
        notes: Iterable[str] = (),
        *,
        slope: float = 0.0,
    ) -> "LabelSource":
        """Image with a number for each voxel (n_x, n_y, n_z), or one for each layer (n_x, n_y, n_z, n_layer).

        Args:
            file: its path.
            values: of the voxels; 0 is outside.
            geometry: spacing, directions and origin.
            stated: labels that the header describes.
            notes: assumptions about the header.
            slope: value of a step of the stored integers; 0 for values that are stored as they are.

        Raises:
            MeshError: values that are no whole numbers.
        """
        whole, deviations = _whole_numbers(values, slope, file)
        layers: dict[int | None, NDArray] = (
            {None: whole} if whole.ndim == 3 else dict(enumerate(np.moveaxis(whole, -1, 0)))
        )
        known = {(segment.layer, segment.value): segment for segment in stated}
        # Most voxels are 0, and sorting all takes its time.
        segments = tuple(
            known.get((layer, int(value)), Segment(int(value), layer=layer))
            for layer, numbers in layers.items()
            for value in np.unique(numbers[numbers != 0])
        )
        x, y, z = whole.shape[:3]
        notes = (*notes, *deviations)
        return cls(file, (x, y, z), geometry, segments, lambda chosen: layers[chosen.layer] == chosen.value, notes)

    @property
    def segments_text(self) -> str:
        """The labels that voxels have, at most 20 of them, for messages."""
        if not self.segments:
            return "there are no labels at all, every voxel is 0"
        separator = ", " if self.segments[0].layer is None else "; "
        dots = f"{separator}..." if len(self.segments) > 20 else ""
        return f"there are labels {separator.join(map(str, self.segments[:20]))}{dots}"


def read_labels(file: Path) -> LabelSource:
    """Read an image file by its suffix.

    Raises:
        MeshError: an unreadable file, an image that is sheared or not of three axes, voxels that are no whole numbers.
    """
    return parsed(file, lambda _: _read(file), "export or copy it again")


def _read(file: Path) -> LabelSource:
    try:
        if file.name.lower().endswith((".nii", ".nii.gz")):
            return _read_nifti(file)
        segmentation = _read_segmentation(file) if file.suffix.lower() == ".dcm" else None
        return segmentation or _read_itk(file)
    except ImportError as error:
        raise MeshError(f"{file}: reading it needs {error.name}: pip install 'surgsim[patient]'") from None


def checked_shape(shape: Sequence[int], file: Path) -> tuple[int, int, int]:
    """Voxel counts of a header's three axes; further axes of length 1 are dropped.

    Raises:
        MeshError: fewer or more axes.
    """
    if len(shape) < 3 or any(count != 1 for count in shape[3:]):
        text = " x ".join(map(str, shape))
        raise MeshError(f"{file}: the image has {len(shape)} axes ({text}); the rule is three: export one volume of it")
    x, y, z = map(int, shape[:3])
    return x, y, z


def _whole_numbers(values: NDArray, slope: float, file: Path) -> tuple[NDArray, list[str]]:
    """Values rounded to whole numbers, and a note on the largest change.

    Integers stored with a slope deviate by up to half of it, floats by their rounding.

    Raises:
        MeshError: other values.
    """
    if values.dtype.kind not in "iubf":
        raise MeshError(f"{file}: the image's values are {values.dtype}; labels are whole numbers: export a label map")
    if values.dtype.kind != "f":
        return values, []
    # From a slope of 1 on, neighbouring labels have the same stored number.
    slack = max(ROUNDING, 0.5 * slope if slope < 1.0 else 0.0)
    # numpy warns of NaNs and infinities; all are wrong here.
    with np.errstate(invalid="ignore"):
        whole = np.rint(values)
        deviation = np.abs(values - whole)
        wrong = ~(deviation <= slack + ROUNDING_SHARE * np.abs(whole))
    stored = f", stored as integers with a slope of {slope:.4g}," if slope else ""
    if wrong.any():
        raise MeshError(
            f"{file}: the image{stored} holds {float(values[wrong][0]):.9g}, which is no whole number: labels are; is "
            "this the scan itself, or resampled with interpolation? Export a label map of integers, resampled by "
            "nearest neighbours"
        )
    largest = float(deviation.max(initial=0.0))
    return whole, [f"the labels{stored} are up to {largest:.2g} off whole numbers: rounded"] if largest else []


def _read_nifti(file: Path) -> LabelSource:
    import nibabel

    with file.open("rb") as stream:
        if file.suffix.lower() == ".nii" and stream.read(2) == b"\x1f\x8b":
            raise MeshError(f"{file}: is compressed by gzip: rename it {file.name}.gz")
    image: Any = nibabel.load(file)
    header, notes = image.header, []
    shape = checked_shape(image.shape, file)
    unit = str(header.get_xyzt_units()[0])
    if unit not in METRES:
        notes.append("the header states no length unit: millimetres are assumed, as NIfTI's readers do")
    metres = METRES.get(unit, 1e-3)
    matrix, origin = np.hsplit(matmul(RAS_TO_LPS, image.affine[:3] * metres), [3])
    geometry = ImageGeometry.from_matrix(matrix, origin[:, 0], file)
    if int(header["sform_code"]):
        notes += _other_places(header, image.affine, shape, metres)
    elif not int(header["qform_code"]):
        notes.append("the header states no orientation: left and right, front and back may be swapped")
    values = np.asanyarray(image.dataobj).reshape(shape)
    slope = abs(float(image.dataobj.slope)) if image.get_data_dtype().kind in "iu" else 0.0
    return LabelSource.from_values(file, values, geometry, _label_table(header.extensions), notes, slope=slope)


def _other_places(header: Any, sform: FloatArray, shape: Sequence[int], metres: float) -> list[str]:
    """Note on a NIfTI header whose qform, or pixdim without one, gives other places than its sform, which applies."""
    spacing, pixdim = norm(sform[:3, :3], axis=0), np.abs(header["pixdim"][1:4])
    try:
        qform, _ = header.get_qform(coded=True)
    except ValueError as error:
        return [f"the header's qform is no rotation ({error}): its sform is used"]
    apart = farthest_corner(sform, sform * np.append(pixdim / spacing, 1.0) if qform is None else qform, shape)
    if apart <= SLACK * spacing.min():
        return []
    return [
        f"the header's sform (voxels of {sides_text(spacing * metres)}) and {'pixdim' if qform is None else 'qform'} "
        f"({sides_text(pixdim * metres)}) differ: a corner of the image lies {apart * metres * 1e3:.4g} mm apart in "
        "them; the sform is used"
    ]


def _label_table(extensions: Iterable[Any]) -> list[Segment]:
    """Labels of the XML table that Connectome Workbench and TotalSegmentator write into NIfTI headers."""
    segments = []
    for extension in extensions:
        content = extension.get_content()
        text = content.decode(errors="replace") if isinstance(content, bytes) else str(content)
        # Names only help: a broken table is as good as none, and so is an extension that is no XML.
        with contextlib.suppress(ElementTree.ParseError, ValueError):
            labels = ElementTree.fromstring(text.strip("\0 \n")).iter("Label")
            segments += [Segment(int(label.get("Key", "")), (label.text or "",)) for label in labels]
    return segments


def _read_itk(file: Path) -> LabelSource:
    """Read an NRRD, MetaImage or DICOM image; several numbers a voxel are layers of 3D Slicer's segments."""
    import SimpleITK

    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)
    reader: Any = SimpleITK.ImageFileReader()
    reader.SetFileName(str(file))
    reader.ReadImageInformation()
    shape = checked_shape(reader.GetSize(), file)
    header: dict[str, str] = {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys()}
    components = reader.GetNumberOfComponents()
    stated = _slicer_segments(header, layered=components > 1)
    if components > 1 and not stated:
        raise MeshError(f"{file}: each voxel has {components} numbers; the rule is one label: export one layer of it")
    dimension = reader.GetDimension()
    direction = np.array(reader.GetDirection()).reshape(dimension, dimension)[:3, :3]
    metres, notes = 1e-3, []
    if file.suffix.lower() in NRRD_SUFFIXES:
        metres = _nrrd_unit(file)
        # Other anatomical spaces are turned into this one by SimpleITK.
        if header.get("NRRD_space") != "left-posterior-superior":
            notes.append("the header names no anatomical space: left, back and up (LPS) are assumed")
    matrix = direction * np.array(reader.GetSpacing()[:3]) * metres
    geometry = ImageGeometry.from_matrix(matrix, np.array(reader.GetOrigin()[:3]) * metres, file)
    # SimpleITK's arrays have the axes reversed, but the layers last.
    values = SimpleITK.GetArrayFromImage(reader.Execute()).reshape(*shape[::-1], components).transpose(2, 1, 0, 3)
    # RescaleSlope (DICOM PS3.6).
    slope = abs(float(header.get("0028|1053", 0.0)))
    layers = values if components > 1 else values[..., 0]
    return LabelSource.from_values(file, layers, geometry, stated, notes, slope=slope)


def _nrrd_unit(file: Path) -> float:
    """Metres per unit of an NRRD file's axes, millimetres if it states none; SimpleITK does not apply units."""
    with file.open("rb") as stream:
        lines = list(iter(lambda: stream.readline().strip(), b""))
    fields = b"".join(line for line in lines if re.match(rb"(space )?units:", line)).decode(errors="replace")
    stated = set(re.findall(r'"([^"]*)"', fields)) - {""} or {"mm"}
    if len(stated) > 1 or not stated <= METRES.keys():
        raise MeshError(
            f"{file}: its axes have units {', '.join(sorted(stated))}; the rule is a single one of "
            f"{', '.join(METRES)}: export it again"
        )
    return METRES[stated.pop()]


def _slicer_segments(header: dict[str, str], *, layered: bool) -> tuple[Segment, ...]:
    """Segments of 3D Slicer's NRRD header; the oldest files have one in each layer, as 1."""
    numbers = sorted({int(match[1]) for match in map(re.compile(r"Segment(\d+)_").match, header) if match})
    segments = []
    for number in numbers:
        key = f"Segment{number}"
        names = [header[f"{key}_{field}"] for field in ("Name", "ID") if f"{key}_{field}" in header]
        layer = int(header.get(f"{key}_Layer", number)) if layered else None
        segments.append(Segment(int(header.get(f"{key}_LabelValue", 1)), (*names, key), layer))
    return tuple(segments)


def _read_segmentation(file: Path) -> LabelSource | None:
    """Read a DICOM segmentation; None for another DICOM file."""
    import pydicom
    from pydicom.uid import UID

    data: Any = pydicom.dcmread(file)
    storage = UID(data.get("SOPClassUID", ""))
    if "PixelData" not in data:
        raise MeshError(f"{file}: has no voxels ({storage.name}): export it as a DICOM segmentation (SEG)")
    if storage not in CLASSES:
        return None
    kind = str(data.SegmentationType)
    if kind not in ("BINARY", "FRACTIONAL", "LABELMAP"):
        raise MeshError(
            f"{file}: its segments are {kind:.80}; the rule is BINARY, FRACTIONAL or LABELMAP: export it so"
        )
    stated = {
        int(entry.SegmentNumber): Segment(int(entry.SegmentNumber), (str(entry.get("SegmentLabel", "")),))
        for entry in data.SegmentSequence
    }
    frames = list(data.get("PerFrameFunctionalGroupsSequence", ()))
    rows, columns = int(data.Rows), int(data.Columns)
    geometry, slices, notes = _geometry(file, data, frames)
    shape = columns, rows, int(slices.max()) + 1
    pixels = np.atleast_3d(data.pixel_array).reshape(len(frames), rows, columns)
    numbers = np.zeros(len(frames), dtype=np.int64)
    if kind != "LABELMAP":
        groups = [_group(data, frame, "SegmentIdentificationSequence") for frame in frames]
        numbers = np.array([int(group.ReferencedSegmentNumber) for group in groups])
    repeated = len(frames) - len(np.unique(np.column_stack([numbers, slices]), axis=0))
    if repeated:
        raise MeshError(f"{file}: {repeated} of its frames repeat a slice; the rule is one for each: export it again")
    if kind == "LABELMAP":
        values = np.zeros(shape, dtype=pixels.dtype)
        values[..., slices] = pixels.T
        return LabelSource.from_values(file, values, geometry, stated.values(), notes)
    smallest = 0.5
    if kind == "FRACTIONAL":
        most, largest = int(data.MaximumFractionalValue), int(pixels.max())
        smallest = 0.5 * most
        text = f"the segments are fractions ({data.get('SegmentationFractionalType')}) of {most}"
        if not 0.0 < smallest <= largest <= most:
            raise MeshError(
                f"{file}: {text}, and the largest value is {largest}; the rule is half of the maximum to the maximum: "
                "export it as BINARY"
            )
        notes.append(f"{text}: voxels of at least half of that are taken")
    used = numbers[(pixels >= smallest).any(axis=(1, 2))]

    def mask(segment: Segment) -> NDArray[np.bool_]:
        inside, chosen = np.zeros(shape, dtype=bool), numbers == segment.value
        inside[..., slices[chosen]] = pixels[chosen].T >= smallest
        return inside

    segments = tuple(stated.get(number, Segment(number)) for number in sorted(set(used.tolist())))
    return LabelSource(file, shape, geometry, segments, mask, tuple(notes))


def _group(data: Any, frame: Any, name: str) -> Any:
    """First item of a functional group: the frame's own, else that of all frames; None without one."""
    shared = data.get("SharedFunctionalGroupsSequence") or [{}]
    return (frame.get(name) or shared[0].get(name) or [None])[0]


def _geometry(file: Path, data: Any, frames: Sequence[Any]) -> tuple[ImageGeometry, NDArray[np.int64], list[str]]:
    """Geometry of the stack, slice of each frame (n_frame,), and notes on the header."""
    names = ("PlaneOrientationSequence", "PlanePositionSequence", "PixelMeasuresSequence")
    planes, positions, measures = ([_group(data, frame, name) for frame in frames] for name in names)
    if not frames or None in (*planes, *positions, *measures):
        raise MeshError(
            f"{file}: its frames have no place in the patient, as of a microscope or an X-ray projection: the rule is "
            "a stack of slices: give a segmentation of CT or MR"
        )
    turns = np.array([plane.ImageOrientationPatient for plane in planes], dtype=float)
    sizes = np.array([measure.PixelSpacing for measure in measures], dtype=float)
    for rows, name, slack in ((turns, "orientations", COSINE_LARGEST), (sizes, "pixel sizes", ROUNDING * sizes.min())):
        if np.ptp(rows, axis=0).max() > slack:
            raise MeshError(
                f"{file}: its frames have {len(np.unique(rows, axis=0))} {name}; the rule is one stack of parallel "
                "slices on one grid: resample it"
            )
    turn = turns[0].reshape(2, 3)
    normal = np.cross(turn[0], turn[1])
    places = np.array([position.ImagePositionPatient for position in positions], dtype=float)
    along = matmul(places, normal)
    step, notes = _slice_step(file, along, measures[0])
    slices = np.rint((along - along.min()) / step).astype(np.int64)
    first = places[int(np.argmin(along))]
    off = norm(places - first - slices[:, None] * step * normal, axis=1)
    if off.max() > SLACK * max(step, 1.0):
        raise MeshError(
            f"{file}: a frame lies {off.max():.3g} mm off an even stack of {step:.4g} mm slices: sheared or uneven "
            "stacks and tiles are refused: resample it onto right-angled axes"
        )
    row_spacing, column_spacing = sizes[0]
    matrix: FloatArray = np.column_stack([turn[0] * column_spacing, turn[1] * row_spacing, normal * step]) * 1e-3
    return ImageGeometry.from_matrix(matrix, first * 1e-3, file), slices, notes


def _slice_step(file: Path, along: FloatArray, measures: Any) -> tuple[float, list[str]]:
    """Distance between slices [mm] of frames at positions along the normal [mm], and notes where statements differ.

    Writers leave out empty frames: the positions alone give a multiple of the step where no two frames are neighbours.
    """
    names = ("SpacingBetweenSlices", "SliceThickness")
    spacing, thickness = (abs(float(measures.get(name) or 0.0)) for name in names)
    apart, extent = np.diff(np.unique(np.round(along, 3))), float(np.ptp(along))
    if not len(apart):
        if not (spacing or thickness):
            raise MeshError(f"{file}: has one slice and states no thickness: export it with SliceThickness")
        return spacing or thickness, []
    nearest = float(apart.min())
    # The mean over the stack is free of the positions' rounding.
    step = extent / round(extent / nearest)
    stated = f"{names[0]} {spacing:.4g}" if spacing else f"{names[1]} {thickness:.4g}"
    text = f"neighbouring frames lie {nearest:.4g} mm apart, and the header states {stated} mm"
    counts = apart / (spacing or nearest)
    if counts.min() > 1.5 and np.abs(counts - np.rint(counts)).max() <= SLACK:
        even = len(apart) > 1 and np.ptp(apart) <= SLACK * nearest
        if not even:
            return extent / round(extent / spacing), [f"{text}: the slices between them are taken as empty"]
        # Two statements outweigh one.
        if abs(thickness - step) > SLACK * step:
            raise MeshError(
                f"{file}: {text}: slices are missing between all of them, or the header is wrong; export it with all "
                "slices, or with the right SpacingBetweenSlices"
            )
    # Slices may overlap: a thickness above the step is no contradiction.
    differs = abs(spacing - step) > SLACK * step if spacing else 0.0 < thickness < (1.0 - SLACK) * step
    return step, [f"{text}: the former is used"] if differs else []
