"""NIfTI label images (.nii, .nii.gz), read run by run."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh_files.mesh_file import parsed
from surgsim_env.patient.label_source import RUN_VOXELS, ImageGeometry, LabelSource, checked_kind, checked_shape

ADVICE = "export or copy it again"
# NIfTI's axes are RAS: x to the right and y to the front.
RAS_TO_LPS = np.diag([-1.0, -1.0, 1.0])
METRES = {"meter": 1.0, "mm": 1e-3, "micron": 1e-6}
# Most that may precede the image's first voxel, and follow its last one [bytes].
HEADER_BYTES = TAIL_BYTES = 1_000_000


def open_nifti(file: Path) -> LabelSource:
    """Read the header of a NIfTI file.

    Raises:
        MeshError: a damaged file or an unsupported header.
    """
    _check_compression(file)
    header = _header(file)
    shape = checked_shape(parsed(file, lambda _: header.get_data_shape(), ADVICE), file)
    dtype = np.dtype(parsed(file, lambda _: header.get_data_dtype(), ADVICE))
    checked_kind(dtype, file)
    offset = int(header.get_data_offset())
    if not 0 <= offset <= HEADER_BYTES:
        raise MeshError(
            f"{file}: its header puts the first voxel at byte {offset} (vox_offset); the rule is 0 to {HEADER_BYTES}: "
            "export it without header extensions"
        )
    slope, shift = parsed(file, lambda _: header.get_slope_inter(), ADVICE)
    scaling = (1.0 if slope is None else float(slope), 0.0 if shift is None else float(shift))
    notes = []
    unit = str(parsed(file, lambda _: header.get_xyzt_units(), ADVICE)[0])
    if unit not in METRES:
        notes.append("the header states no length unit: millimetres are assumed, as NIfTI's readers do")
    if not int(header["sform_code"]) and not int(header["qform_code"]):
        notes.append("the header states no orientation: left and right, front and back may be swapped")
    affine = np.asarray(parsed(file, lambda _: header.get_best_affine(), ADVICE), dtype=np.float64)
    affine = affine * METRES.get(unit, 1e-3)
    geometry = ImageGeometry.from_matrix(RAS_TO_LPS @ affine[:3, :3], RAS_TO_LPS @ affine[:3, 3], file)

    def runs() -> Iterator[tuple[int, NDArray]]:
        yield from _runs(file, shape, dtype, offset, scaling)

    return LabelSource(file, shape, geometry, runs, tuple(notes))


def _check_compression(file: Path) -> None:
    with file.open("rb") as stream:
        packed = stream.read(2) == b"\x1f\x8b"
    if packed != file.name.lower().endswith(".gz"):
        name, what = (".nii.gz", "is not") if not packed else (".nii", "is")
        raise MeshError(f"{file}: is named {name} and {what} compressed by gzip: rename it, or {ADVICE}")


def _header(file: Path) -> Any:
    """The header without its extensions, whose stated sizes nibabel.load would trust."""
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
            size = kind.template_dtype.itemsize
            return parsed(file, lambda _, kind=kind, size=size: kind.from_fileobj(io.BytesIO(raw[:size])), ADVICE)
    raise MeshError(f"{file}: is no NIfTI image of one file (no n+1 or n+2 in its header): {ADVICE}")


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
            yield first, values if scaling == (1.0, 0.0) else values * slope + shift
        if len(parsed(file, lambda _: stream.read(TAIL_BYTES), ADVICE)) >= TAIL_BYTES:
            raise MeshError(f"{file}: goes on far beyond the image that its header describes: {ADVICE}")
