"""Label images that SimpleITK reads: NRRD, MetaImage, and DICOM files of one volume."""

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
# SimpleITK reads whole images [bytes].
BYTES_MOST = 4_000_000_000
SLICES = 16
READERS = {".nrrd": "NrrdImageIO", ".mha": "MetaImageIO", ".dcm": "GDCMImageIO"}
# DICOM's class of segmentations, the tags of class, frames and of a segment's number.
SEGMENTATION_CLASS = "1.2.840.10008.5.1.4.1.1.66.4"
CLASS_TAG = "0008|0016"


def open_itk(file: Path) -> LabelSource:
    """Look into an NRRD, MHA or DICOM file.

    Raises:
        MeshError: names the file and what is wrong with it, its header, or what SimpleITK cannot tell of it.
    """
    try:
        import SimpleITK
    except ImportError:
        raise MeshError(f"{file}: reading {file.suffix} needs SimpleITK: pip install 'surgsim[patient]'") from None
    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)
    reader: Any = SimpleITK.ImageFileReader()
    reader.SetImageIO(READERS[file.suffix.lower()])
    reader.SetFileName(str(file))
    parsed(file, lambda _: reader.ReadImageInformation(), ADVICE)
    if file.suffix.lower() == ".dcm":
        _check_dicom(reader, file)
    shape = checked_shape(reader.GetSize(), file)
    components = reader.GetNumberOfComponents()
    if components != 1:
        raise MeshError(f"{file}: each voxel has {components} numbers; the rule is one label: export one layer of it")
    pixel = SimpleITK.GetPixelIDValueAsString(reader.GetPixelID())
    width = next((size for name, size in (("8-bit", 1), ("16-bit", 2), ("32-bit", 4)) if name in pixel), 8)
    if np.prod(np.array(shape, dtype=np.float64)) * width > BYTES_MOST:
        raise MeshError(
            f"{file}: holds {' x '.join(map(str, shape))} voxels of {width} bytes; at most {BYTES_MOST / 1e9:g} GB of "
            f"this format are read at once: crop it, or save it as {8}-bit NIfTI"
        )
    dimension = reader.GetDimension()
    direction = np.array(reader.GetDirection()).reshape(dimension, dimension)[:3, :3]
    matrix = direction * np.array(reader.GetSpacing()[:3]) * 1e-3
    geometry = ImageGeometry.from_matrix(matrix, np.array(reader.GetOrigin()[:3]) * 1e-3, file)
    notes = _stated_space(file)

    def slabs() -> Iterator[tuple[int, NDArray]]:
        image = parsed(file, lambda _: reader.Execute(), ADVICE)
        values = SimpleITK.GetArrayViewFromImage(image).reshape(shape[::-1]).T
        for first in range(0, shape[2], SLICES):
            yield first, values[:, :, first : first + SLICES]

    return LabelSource(file, shape, geometry, slabs, notes)


def _check_dicom(reader: Any, file: Path) -> None:
    """Refuse segmentation objects whose frames SimpleITK stacks without knowing which segment and place each has."""
    is_segmentation = (
        CLASS_TAG in reader.GetMetaDataKeys() and reader.GetMetaData(CLASS_TAG).strip() == SEGMENTATION_CLASS
    )
    # SimpleITK gives neither the frames' segments nor their places; dcmqi does.
    if is_segmentation:
        raise MeshError(
            f"{file}: is a DICOM segmentation object, of whose frames SimpleITK tells neither segment nor place: "
            "convert it first, for instance: segimage2itkimage --inputDICOM FILE --outputDirectory DIR -t nii (dcmqi)"
        )


def _stated_space(file: Path) -> tuple[str, ...]:
    """A note where an NRRD header names no anatomical space: ITK then takes LPS."""
    if file.suffix.lower() != ".nrrd":
        return ()
    with file.open("rb") as stream:
        head = stream.read(20_000).partition(b"\n\n")[0].decode("ascii", errors="replace").lower()
    if "\nspace:" in head:
        return ()
    return ("the header names no anatomical space: left, back and up (LPS) are taken",)
