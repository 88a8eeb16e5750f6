"""NIfTI label images (.nii, .nii.gz), read slice by slice."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh_file import parsed
from surgsim_env.patient.image_geometry import ImageGeometry
from surgsim_env.patient.label_image import LabelSource, checked_shape

ADVICE = "export or copy it again"
# NIfTI's world is RAS, x to the right and y to the front.
RAS_TO_LPS = np.diag([-1.0, -1.0, 1.0])
METRES = {"meter": 1.0, "mm": 1e-3, "micron": 1e-6}
# So much is read at once, and so much may follow the image's last voxel [bytes].
SLAB_BYTES = 32_000_000
TAIL_BYTES = 1_000_000


def open_nifti(file: Path) -> LabelSource:
    """Look into a NIfTI file.

    Raises:
        MeshError: names the file and what is wrong with it or its header.
    """
    try:
        import nibabel
    except ImportError:
        raise MeshError(f"{file}: reading NIfTI needs nibabel: pip install 'surgsim[patient]'") from None
    _check_compression(file)
    image: Any = parsed(file, nibabel.load, ADVICE)
    header = image.header
    shape = checked_shape(image.shape, file)
    notes = []
    unit = str(header.get_xyzt_units()[0])
    if unit not in METRES:
        notes.append("the header states no length unit: millimetres are taken, as NIfTI's readers do")
    if not int(header["sform_code"]) and not int(header["qform_code"]):
        notes.append("the header states no orientation: left and right, front and back may be swapped")
    metres = METRES.get(unit, 1e-3)
    affine = np.asarray(image.affine, dtype=np.float64) * metres
    geometry = ImageGeometry.from_matrix(RAS_TO_LPS @ affine[:3, :3], RAS_TO_LPS @ affine[:3, 3], file)
    data = image.dataobj

    def slabs() -> Iterator[tuple[int, NDArray]]:
        yield from _slabs(file, shape, data)

    return LabelSource(file, shape, geometry, slabs, tuple(notes))


def _check_compression(file: Path) -> None:
    with file.open("rb") as stream:
        packed = stream.read(2) == b"\x1f\x8b"
    if packed != file.name.lower().endswith(".gz"):
        name, what = (".nii.gz", "is not") if not packed else (".nii", "is")
        raise MeshError(f"{file}: is named {name} and {what} compressed by gzip: rename it, or {ADVICE}")


def _slabs(file: Path, shape: tuple[int, int, int], data: Any) -> Iterator[tuple[int, NDArray]]:
    """(first slice, values) along the last axis; the whole file is read, so that gzip's checksum is looked at."""
    from nibabel.openers import ImageOpener

    dtype = np.dtype(data.dtype)
    layer = shape[0] * shape[1]
    count = max(1, SLAB_BYTES // (layer * dtype.itemsize))
    slope, shift = float(data.slope), float(data.inter)
    stream: Any = ImageOpener(str(file))
    with stream:
        parsed(file, lambda _: stream.seek(data.offset), ADVICE)
        for first in range(0, shape[2], count):
            slices = min(count, shape[2] - first)
            wanted = layer * slices * dtype.itemsize
            raw = parsed(file, lambda _, size=wanted: stream.read(size), ADVICE)
            if len(raw) < wanted:
                raise MeshError(
                    f"{file}: is cut short: its header promises {' x '.join(map(str, shape))} voxels, the data end "
                    f"within slice {first + len(raw) // (layer * dtype.itemsize)} of {shape[2]}: {ADVICE}"
                )
            values = np.frombuffer(raw, dtype=dtype).reshape((shape[0], shape[1], slices), order="F")
            yield first, values if (slope, shift) == (1.0, 0.0) else values * slope + shift
        if len(parsed(file, lambda _: stream.read(TAIL_BYTES), ADVICE)) >= TAIL_BYTES:
            raise MeshError(f"{file}: goes on far beyond the image that its header describes: {ADVICE}")
