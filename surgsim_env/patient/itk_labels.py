"""Label images that SimpleITK reads: NRRD, MetaImage, and plain DICOM images."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msdm_core.errors import MeshError
from msdm_core.mesh_files.mesh_file import parsed
from surgsim_env.patient.label_source import RUN_VOXELS, ImageGeometry, LabelSource, checked_shape

ADVICE = "export or copy it again"
# SimpleITK reads whole images [bytes].
BYTES_MOST = 4_000_000_000
# Only the end of SimpleITK's long messages is quoted [characters].
REASON_LENGTH = 200
READERS = {".nrrd": "NrrdImageIO", ".mha": "MetaImageIO", ".dcm": "GDCMImageIO"}


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
    if np.prod(np.array(shape, dtype=np.float64)) * width > BYTES_MOST:
        raise MeshError(
            f"{file}: holds {' x '.join(map(str, shape))} voxels of {width} bytes; at most {BYTES_MOST / 1e9:g} GB of "
            f"this format are read at once: crop it, or save it as NIfTI of 8 bits"
        )
    dimension = reader.GetDimension()
    direction = np.array(reader.GetDirection()).reshape(dimension, dimension)[:3, :3]
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


def _asked(file: Path, question: Callable[[], Any]) -> Any:
    """The result of a call to SimpleITK; its error messages without the positions in its own sources."""
    try:
        return parsed(file, lambda _: question(), ADVICE)
    except MeshError as error:
        lines = [line.strip() for line in str(error.__cause__).splitlines() if line.strip()]
        raise MeshError(f"{file}: cannot be parsed: {' '.join(lines)[-REASON_LENGTH:]}: {ADVICE}") from None


def _stated_space(file: Path) -> tuple[str, ...]:
    """A note if an NRRD header names no anatomical space: ITK then assumes LPS."""
    if file.suffix.lower() != ".nrrd":
        return ()
    with file.open("rb") as stream:
        head = stream.read(20_000).partition(b"\n\n")[0].decode("ascii", errors="replace").lower()
    if "\nspace:" in head:
        return ()
    return ("the header names no anatomical space: left, back and up (LPS) are assumed",)
