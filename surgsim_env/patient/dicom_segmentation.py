"""DICOM segmentation objects (SEG): frames of segments, assembled into one label image."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh.tet_mesh import FloatArray
from msdm_core.mesh_files.mesh_file import parsed
from surgsim_env.patient.label_source import ImageGeometry, LabelSource, checked_shape

ADVICE = "export or copy it again"
# Segmentation Storage and Label Map Segmentation Storage (DICOM PS3.4, B.5).
CLASSES = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")
# pydicom holds the whole file and its unpacked frames in memory [bytes].
BYTES_MOST = 2_000_000_000
# Frame positions may be off the grid by this share of the slice step, or of 1 mm where slices are thinner.
SLACK = 0.02
REASON_LENGTH = 200


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
    if file.stat().st_size > BYTES_MOST:
        raise MeshError(f"{file}: has more than {BYTES_MOST / 1e9:g} GB: crop it to the organ")
    data: Any = parsed(file, pydicom.dcmread, ADVICE)
    if str(data.get("SOPClassUID", "")) not in CLASSES:
        return None
    try:
        return _source(file, data, wanted)
    except (AttributeError, KeyError, IndexError, TypeError) as error:
        reason = " ".join(str(error).split())[:REASON_LENGTH]
        raise MeshError(f"{file}: is no complete DICOM segmentation ({reason}): {ADVICE}") from None


def _source(file: Path, data: Any, wanted: Sequence[int]) -> LabelSource:
    kind = str(data.SegmentationType)
    if kind not in ("BINARY", "LABELMAP"):
        raise MeshError(f"{file}: its segments are {kind}; the rule is BINARY or LABELMAP: export it so")
    segments = {int(one.SegmentNumber): str(one.SegmentLabel) for one in data.SegmentSequence}
    missing = [number for number in wanted if number not in segments]
    if missing:
        there = ", ".join(f"{number} ({name!r})" for number, name in sorted(segments.items())[:20])
        raise MeshError(f"{file}: segment {missing[0]} is nowhere in it; there are {there}: correct --labels")
    frames = list(data.PerFrameFunctionalGroupsSequence)
    rows, columns = int(data.Rows), int(data.Columns)
    checked_shape((columns, rows, len(frames)), file)
    geometry, slices = _geometry(file, data, frames)
    shape = checked_shape((columns, rows, int(slices.max()) + 1), file)
    numbers = None
    if kind == "BINARY":
        numbers = [
            int(_group(data, frame, "SegmentIdentificationSequence").ReferencedSegmentNumber) for frame in frames
        ]

    def runs() -> Iterator[tuple[int, NDArray]]:
        pixels = parsed(file, lambda _: np.atleast_3d(data.pixel_array), ADVICE).reshape(len(frames), rows, columns)
        for place in range(shape[2]):
            layer = np.zeros((columns, rows, 1), dtype=np.int64)
            here = np.flatnonzero(slices == place)
            if numbers is None:
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
    if name in frame:
        return frame[name][0]
    return data.SharedFunctionalGroupsSequence[0][name][0]


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
    along = places @ normal
    step = _slice_step(file, along, measures)
    slices = np.rint((along - along.min()) / step).astype(np.int64)
    first = places[int(np.argmin(along))]
    off = np.linalg.norm(places - first - slices[:, None] * step * normal, axis=1)
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
