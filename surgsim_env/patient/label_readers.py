"""Readers of label images, NIfTI, NRRD, MetaImage and DICOM: shape, geometry in the patient, and voxels in runs."""

import contextlib
import io
import logging
import os
import re
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from logging.handlers import BufferingHandler
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.arithmetic import arccos, matmul, norm, svd
from msdm_core.errors import MeshError
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.mesh_files.mesh_file import parsed

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
ADVICE = "export or copy it again"
# NIfTI's axes are RAS: x to the right and y to the front.
RAS_TO_LPS = np.diag([-1.0, -1.0, 1.0])
METRES = {"meter": 1.0, "mm": 1e-3, "micron": 1e-6}
# Most that may precede the image's first voxel, and follow its last one [bytes].
HEADER_BYTES = TAIL_BYTES = 1_000_000
# nibabel has some ten checks of a header, one remark each.
REMARKS_MOST = 100
# SimpleITK and pydicom read whole images: most that the image, the decoder's copies of it and the labels found, a byte
# a voxel, may take together [bytes].
IMAGE_BYTES_MOST = 1_600_000_000
# What they hold of an image at once: ITK unpacks NRRD and MetaImage in place, GDCM and pydicom copy.
COPIES = {".nrrd": 1, ".mha": 1, ".dcm": 2}
# Only so much of a library's message is quoted [characters].
REASON_LENGTH = 200
READERS = {".nrrd": "NrrdImageIO", ".mha": "MetaImageIO", ".dcm": "GDCMImageIO"}
# MetaImage's reader has room for so many axes, and checks it too late.
META_AXES_MOST = 10
# Entries of the headers of NRRD and MetaImage, "name: value" and "name = value", within so many bytes.
TEXT_HEADER_BYTES = 100_000
TEXT_ENTRY = re.compile(r"^([A-Za-z_ ]{1,40})[=:]([^\n]*)$", re.MULTILINE)
# Segmentation Storage and Label Map Segmentation Storage (DICOM PS3.4, B.5).
CLASSES = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")
# Frame positions may be off the grid by this share of the slice step, or of 1 mm where slices are thinner.
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
        # Of numbers above 1e154 it is infinite, and refused.
        with np.errstate(over="ignore"):
            spacing = norm(matrix, axis=0)
        low, high = SPACING_RANGE
        if not ((spacing >= low) & (spacing <= high)).all():
            shown = " x ".join(f"{one * 1e3:.4g}" for one in spacing)
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
        """The geometry of a part of the image that begins at voxel `corner` (3,)."""
        return ImageGeometry(self.spacing, self.direction, self.places(np.asarray(corner) * self.spacing))

    def places(self, points: FloatArray) -> FloatArray:
        """LPS positions (..., 3) [m] of points given along the image's axes from voxel (0, 0, 0), (..., 3) [m]."""
        return self.origin + matmul(points, self.direction.T)

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
    # numpy warns of a NaN of another kind than its own; all are wrong here.
    with np.errstate(invalid="ignore"):
        wrong = (values != np.rint(values)) | ~np.isfinite(values)
    if wrong.any():
        raise MeshError(
            f"{file}: the image holds {float(values[wrong][0]):g}, which is no whole number: labels are; is this the "
            "scan itself, or resampled with interpolation? Export a label map, resampled by nearest neighbours"
        )
    return values


def open_nifti(file: Path) -> LabelSource:
    """Read the header of a NIfTI file.

    Raises:
        MeshError: a damaged file or an unsupported header.
    """
    with file.open("rb") as stream:
        packed = stream.read(2) == b"\x1f\x8b"
    if packed != file.name.lower().endswith(".gz"):
        name, what = (".nii.gz", "is not") if not packed else (".nii", "is")
        raise MeshError(f"{file}: is named {name} and {what} compressed by gzip: rename it, or {ADVICE}")
    header, notes = _header(file)
    shape = checked_shape(parsed(file, lambda _: header.get_data_shape(), ADVICE), file)
    dtype = np.dtype(parsed(file, lambda _: header.get_data_dtype(), ADVICE))
    checked_kind(dtype, file)
    # The header's own number, infinite or not; nibabel's method would make a whole number of it.
    stated = float(header["vox_offset"])
    if not 0 <= stated <= HEADER_BYTES:
        raise MeshError(
            f"{file}: its header puts the first voxel at byte {stated:.10g} (vox_offset); the rule is 0 to "
            f"{HEADER_BYTES}: export it without header extensions"
        )
    offset = int(header.get_data_offset())
    slope, shift = parsed(file, lambda _: header.get_slope_inter(), ADVICE)
    scaling = (1.0 if slope is None else float(slope), 0.0 if shift is None else float(shift))
    unit = str(parsed(file, lambda _: header.get_xyzt_units(), ADVICE)[0])
    if unit not in METRES:
        notes.append("the header states no length unit: millimetres are assumed, as NIfTI's readers do")
    if not int(header["sform_code"]) and not int(header["qform_code"]):
        notes.append("the header states no orientation: left and right, front and back may be swapped")
    affine = np.asarray(parsed(file, lambda _: header.get_best_affine(), ADVICE), dtype=np.float64)
    # What is or becomes infinite is refused with the geometry.
    with np.errstate(over="ignore", invalid="ignore"):
        matrix, origin = np.hsplit(matmul(RAS_TO_LPS, affine[:3] * METRES.get(unit, 1e-3)), [3])
    geometry = ImageGeometry.from_matrix(matrix, origin[:, 0], file)

    runs = partial(_runs, file, shape, dtype, offset, scaling)
    return LabelSource(file, shape, geometry, runs, tuple(notes))


def _header(file: Path) -> tuple[Any, list[str]]:
    """The header without its extensions, whose stated sizes nibabel.load would trust, and what nibabel mended in it."""
    try:
        from nibabel.nifti1 import Nifti1Header
        from nibabel.nifti2 import Nifti2Header
    except ImportError:
        raise MeshError(f"{file}: reading NIfTI needs nibabel: pip install 'surgsim[patient]'") from None
    raw = parsed(file, lambda _: _opened(file, Nifti2Header.template_dtype.itemsize), ADVICE)
    if len(raw) < Nifti1Header.template_dtype.itemsize:
        raise MeshError(f"{file}: is cut short: it ends within its header, after {len(raw)} bytes: {ADVICE}")
    # Positions of the magic words in the two versions of the format.
    for kind, magic, place in ((Nifti1Header, b"n+1\0", 344), (Nifti2Header, b"n+2\0", 4)):
        if raw[place : place + 4] == magic:
            block = io.BytesIO(raw[: kind.template_dtype.itemsize])
            return parsed(file, lambda _, kind=kind, block=block: _checked_header(kind, block), ADVICE)
    raise MeshError(f"{file}: is no NIfTI image of one file (no n+1 or n+2 in its header): {ADVICE}")


def _checked_header(kind: Any, block: io.BytesIO) -> tuple[Any, list[str]]:
    """A header after nibabel's checks. Their remarks go to a logger of this call; nibabel's own prints to stderr."""
    header, said = kind.from_fileobj(block, check=False), BufferingHandler(REMARKS_MOST)
    logger = logging.Logger(__name__, logging.WARNING)
    logger.addHandler(said)
    header.check_fix(logger=logger)
    return header, [f"the header is unusual: {record.getMessage()}" for record in said.buffer]


def _opened(file: Path, size: int) -> bytes:
    from nibabel.openers import ImageOpener

    stream: Any = ImageOpener(str(file))
    with stream:
        return stream.read(size)


def _runs(
    file: Path, shape: tuple[int, int, int], dtype: np.dtype, offset: int, scaling: tuple[float, float]
) -> Iterator[tuple[int, NDArray]]:
    """Runs of (first voxel, values); reads the whole file, so that gzip's checksum is verified."""
    from nibabel.openers import ImageOpener

    layer, total = shape[0] * shape[1], shape[0] * shape[1] * shape[2]
    slope, shift = scaling
    stream: Any = ImageOpener(str(file))
    with stream:
        parsed(file, lambda _: stream.seek(offset), ADVICE)
        for first in range(0, total, RUN_VOXELS):
            wanted = min(RUN_VOXELS, total - first) * dtype.itemsize
            raw = parsed(file, lambda _, size=wanted: stream.read(size), ADVICE)
            if len(raw) < wanted:
                raise MeshError(
                    f"{file}: is cut short: its header promises {' x '.join(map(str, shape))} voxels, the data end "
                    f"within slice {(first + len(raw) // dtype.itemsize) // layer} of {shape[2]}: {ADVICE}"
                )
            values = np.frombuffer(raw, dtype=dtype)
            # A number that overflows is no label: whoever takes the values refuses it.
            with np.errstate(over="ignore"):
                scaled = values if scaling == (1.0, 0.0) else values * slope + shift
            yield first, scaled
        if len(parsed(file, lambda _: stream.read(TAIL_BYTES), ADVICE)) >= TAIL_BYTES:
            raise MeshError(f"{file}: goes on far beyond the image that its header describes: {ADVICE}")


def open_itk(file: Path) -> LabelSource:
    """Read the header of an NRRD, MHA or DICOM file.

    Raises:
        MeshError: a damaged file, an unsupported header, or a file that SimpleITK cannot parse.
    """
    try:
        import SimpleITK
    except ImportError:
        raise MeshError(f"{file}: reading {file.suffix} needs SimpleITK: pip install 'surgsim[patient]'") from None
    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)
    if file.suffix.lower() != ".dcm":
        _check_text_header(file)
    reader: Any = SimpleITK.ImageFileReader()
    reader.SetImageIO(READERS[file.suffix.lower()])
    reader.SetFileName(str(file))
    _asked(file, reader.ReadImageInformation)
    shape = checked_shape(reader.GetSize(), file)
    components = reader.GetNumberOfComponents()
    if components != 1:
        raise MeshError(f"{file}: each voxel has {components} numbers; the rule is one label: export one layer of it")
    pixel = SimpleITK.GetPixelIDValueAsString(reader.GetPixelID())
    width = next((size for name, size in (("8-bit", 1), ("16-bit", 2), ("32-bit", 4)) if name in pixel), 8)
    _check_memory(file, shape, width)
    dimension = reader.GetDimension()
    direction = np.array(reader.GetDirection()).reshape(dimension, dimension)[:3, :3]
    # What becomes infinite is refused with the geometry.
    with np.errstate(over="ignore", invalid="ignore"):
        matrix = direction * np.array(reader.GetSpacing()[:3]) * 1e-3
    geometry = ImageGeometry.from_matrix(matrix, np.array(reader.GetOrigin()[:3]) * 1e-3, file)
    notes = _stated_space(file)

    def runs() -> Iterator[tuple[int, NDArray]]:
        image = _asked(file, reader.Execute)
        # SimpleITK's arrays have the axes reversed, so that the image's first axis is the fastest.
        values = SimpleITK.GetArrayViewFromImage(image).reshape(-1)
        for first in range(0, len(values), RUN_VOXELS):
            yield first, values[first : first + RUN_VOXELS]

    return LabelSource(file, shape, geometry, runs, notes)


def _check_text_header(file: Path) -> None:
    """Refuse entries of an NRRD or MetaImage header with which ITK's readers crash, hang or take memory without end."""
    with file.open("rb") as stream:
        head = stream.read(TEXT_HEADER_BYTES).decode("latin-1")
    entries = [(match[1].strip().lower(), match[2].strip()) for match in TEXT_ENTRY.finditer(head)]
    for name, value in entries:
        wrong = ""
        if name == "ndims" and not (value.isdecimal() and 1 <= int(value) <= META_AXES_MOST):
            wrong = f"a whole number from 1 to {META_AXES_MOST}"
        elif name == "compresseddatasize" and not (value.isdecimal() and int(value) <= file.stat().st_size):
            wrong = f"at most the file's {file.stat().st_size} bytes"
        # The readers use it as a format of C, which may say anything.
        elif name in ("elementdatafile", "data file", "datafile") and ("%" in value or value.startswith("LIST")):
            wrong = "LOCAL or the name of one file"
        if wrong:
            shown = value if len(value) <= 40 else f"{value[:40]}..."
            raise MeshError(f"{file}: its header's {name} is {shown!r}; the rule is {wrong}: {ADVICE}")


def _check_memory(file: Path, shape: tuple[int, int, int], width: int) -> None:
    """Refuse, before it is decoded, an image whose voxels of `width` bytes take more than IMAGE_BYTES_MOST."""
    voxels, copies = shape[0] * shape[1] * shape[2], COPIES[file.suffix.lower()]
    taken = voxels * (copies * width + 1)
    if taken > IMAGE_BYTES_MOST:
        raise MeshError(
            f"{file}: holds {' x '.join(map(str, shape))} voxels of {width} bytes, which take {taken / 1e9:.3g} GB to "
            f"read; at most {IMAGE_BYTES_MOST / 1e9:g} GB of this format are read at once: crop it, or save it as "
            "NIfTI, which is read in parts"
        )


def _asked(file: Path, question: Callable[[], Any]) -> Any:
    """The result of a call to SimpleITK; its error messages without the positions in its own sources."""
    with _printed_in_c() as printed:
        try:
            return parsed(file, lambda _: question(), ADVICE)
        except MeshError as error:
            lines = [line.strip() for line in str(error.__cause__).splitlines() if line.strip()]
            reason = " ".join([*lines, *printed().split()])[-REASON_LENGTH:]
            raise MeshError(f"{file}: cannot be parsed: {reason}: {ADVICE}") from None


@contextlib.contextmanager
def _printed_in_c() -> Iterator[Callable[[], str]]:
    """Keep what C++ code prints to standard error (MetaImage's reader does) off it; the function gives it."""
    before = os.dup(2)
    with tempfile.TemporaryFile() as said:

        def text() -> str:
            said.seek(0)
            return said.read().decode(errors="replace")

        os.dup2(said.fileno(), 2)
        try:
            yield text
        finally:
            os.dup2(before, 2)
            os.close(before)


def _stated_space(file: Path) -> tuple[str, ...]:
    """A note if an NRRD header names no anatomical space: ITK then assumes LPS."""
    if file.suffix.lower() != ".nrrd":
        return ()
    with file.open("rb") as stream:
        head = stream.read(20_000).partition(b"\n\n")[0].decode("ascii", errors="replace").lower()
    if "\nspace:" in head:
        return ()
    return ("the header names no anatomical space: left, back and up (LPS) are assumed",)


def open_segmentation(file: Path, wanted: Sequence[int]) -> LabelSource | None:
    """Read the header of a DICOM file; None if it is no segmentation object.

    Args:
        file: the file.
        wanted: segment numbers; where segments overlap, the later one in this list applies.

    Raises:
        MeshError: a damaged or unsupported file; a wanted segment that is not there (lists those that are).
    """
    try:
        import pydicom
    except ImportError:
        raise MeshError(f"{file}: reading DICOM needs pydicom: pip install 'surgsim[patient]'") from None
    # pydicom holds the whole file.
    if file.stat().st_size > IMAGE_BYTES_MOST:
        raise MeshError(f"{file}: has more than {IMAGE_BYTES_MOST / 1e9:g} GB: crop it to the organ")
    parsed(file, lambda _: _check_deflated(file), ADVICE)
    data: Any = parsed(file, pydicom.dcmread, ADVICE)
    # pydicom converts an element when it is asked for, with warnings and errors of any type.
    if parsed(file, lambda _: str(data.get("SOPClassUID", "")), ADVICE) not in CLASSES:
        return None
    return parsed(file, lambda _: _complete_source(file, data, wanted), ADVICE)


def _check_deflated(file: Path) -> None:
    """Refuse a deflated data set that unpacks to more than IMAGE_BYTES_MOST; pydicom would unpack it at once."""
    from pydicom.filereader import read_file_meta_info
    from pydicom.uid import DeflatedExplicitVRLittleEndian

    meta = read_file_meta_info(file)
    if meta.get("TransferSyntaxUID") != DeflatedExplicitVRLittleEndian:
        return
    unpacked, inflate = 0, zlib.decompressobj(-zlib.MAX_WBITS)
    with file.open("rb") as stream:
        # The preamble with its magic word, and the element that states the length of the file meta information.
        stream.seek(144 + int(meta.FileMetaInformationGroupLength))
        waiting = stream.read(RUN_VOXELS)
        while waiting and not inflate.eof:
            unpacked += len(inflate.decompress(waiting, RUN_VOXELS))
            if unpacked > IMAGE_BYTES_MOST:
                raise ValueError(f"its deflated data are more than {IMAGE_BYTES_MOST / 1e9:g} GB: crop it to the organ")
            waiting = inflate.unconsumed_tail or stream.read(RUN_VOXELS)


def _complete_source(file: Path, data: Any, wanted: Sequence[int]) -> LabelSource:
    try:
        return _source(file, data, wanted)
    except (AttributeError, KeyError, IndexError, TypeError) as error:
        reason = " ".join(str(error).split())[:REASON_LENGTH]
        raise MeshError(f"{file}: is no complete DICOM segmentation ({reason}): {ADVICE}") from None


def _source(file: Path, data: Any, wanted: Sequence[int]) -> LabelSource:
    kind = str(data.SegmentationType)
    if kind not in ("BINARY", "LABELMAP"):
        raise MeshError(f"{file}: its segments are {kind:.80}; the rule is BINARY or LABELMAP: export it so")
    segments = {int(one.SegmentNumber): str(one.SegmentLabel) for one in data.SegmentSequence}
    missing = [number for number in wanted if number not in segments]
    if missing:
        there = ", ".join(f"{number} ({name!r})" for number, name in sorted(segments.items())[:20])
        raise MeshError(f"{file}: segment {missing[0]} is nowhere in it; there are {there}: correct --labels")
    frames = list(data.PerFrameFunctionalGroupsSequence)
    rows, columns = int(data.Rows), int(data.Columns)
    stated = int(data.NumberOfFrames)
    if stated != len(frames):
        raise MeshError(f"{file}: states {stated} frames and describes {len(frames)}: {ADVICE}")
    width = -(-int(data.BitsAllocated) * int(data.SamplesPerPixel) // 8)
    _check_memory(file, checked_shape((columns, rows, len(frames)), file), width)
    geometry, slices = _geometry(file, data, frames)
    shape = checked_shape((columns, rows, int(slices.max()) + 1), file)
    identified = frames if kind == "BINARY" else []
    numbers = [int(_group(data, one, "SegmentIdentificationSequence").ReferencedSegmentNumber) for one in identified]

    def runs() -> Iterator[tuple[int, NDArray]]:
        layers = (len(frames), rows, columns)
        pixels = parsed(file, lambda _: np.atleast_3d(data.pixel_array).reshape(layers), ADVICE)
        for place in range(shape[2]):
            layer = np.zeros((columns, rows, 1), dtype=np.int64)
            here = np.flatnonzero(slices == place)
            if kind == "LABELMAP":
                for frame in here:
                    layer[..., 0] = pixels[frame].T
            else:
                for number in wanted:
                    for frame in here:
                        if numbers[frame] == number:
                            layer[pixels[frame].T > 0] = number
            yield place * rows * columns, layer.ravel(order="F")

    return LabelSource(file, shape, geometry, runs)


def _group(data: Any, frame: Any, name: str) -> Any:
    """The first item of a functional group: the frame's own, else the one shared by all frames."""
    return (frame if name in frame else data.SharedFunctionalGroupsSequence[0])[name][0]


def _geometry(file: Path, data: Any, frames: Sequence[Any]) -> tuple[ImageGeometry, NDArray[np.int64]]:
    """The geometry of the stack and the slice of each frame (n_frame,)."""
    turns = {tuple(map(float, _group(data, one, "PlaneOrientationSequence").ImageOrientationPatient)) for one in frames}
    measures = _group(data, frames[0], "PixelMeasuresSequence")
    if len(turns) != 1:
        raise MeshError(
            f"{file}: its frames have {len(turns)} orientations; the rule is one stack of parallel slices: resample it"
        )
    turn = np.array(turns.pop()).reshape(2, 3)
    normal = np.cross(turn[0], turn[1])
    places = np.array([_group(data, one, "PlanePositionSequence").ImagePositionPatient for one in frames], dtype=float)
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
    """Distance between slices [mm], from the frames' positions along the normal [mm]; for one slice the stated one."""
    apart = np.diff(np.unique(np.round(along, 3)))
    if len(apart):
        # Averaged over the whole stack, so that rounded positions do not add up to an error.
        return float(np.ptp(along) / max(round(np.ptp(along) / apart.min()), 1))
    stated = measures.get("SpacingBetweenSlices") or measures.get("SliceThickness")
    if stated is None:
        raise MeshError(f"{file}: has one slice and states no thickness: export it with SliceThickness")
    return float(stated)
