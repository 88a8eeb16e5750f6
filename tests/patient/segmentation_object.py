"""A DICOM segmentation object as a workstation writes it, for tests."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pydicom
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.pixels import pack_bits
from pydicom.sequence import Sequence
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

SEGMENTATION = "1.2.840.10008.5.1.4.1.1.66.4"


def item(**values) -> Dataset:
    data = Dataset()
    for name, value in values.items():
        setattr(data, name, value)
    return data


def write_segmentation(path: Path, masks: dict[str, np.ndarray], spacing, origin, *, shift=0.0) -> Path:
    """Masks (n_x, n_y, n_z) by name, numbered from 1, on LPS axes; `shift` moves each slice further along x [mm]."""
    frames, pixels = [], []
    for number, mask in enumerate(masks.values(), start=1):
        # From the last slice to the first, empty ones left out: the order is no one's duty.
        for k in reversed(range(mask.shape[2])):
            if not mask[..., k].any():
                continue
            place = [origin[0] + shift * k, origin[1], origin[2] + spacing[2] * k]
            frames.append(
                item(
                    SegmentIdentificationSequence=Sequence([item(ReferencedSegmentNumber=number)]),
                    PlanePositionSequence=Sequence([item(ImagePositionPatient=place)]),
                )
            )
            pixels.append(mask[..., k].T)
    data = item(
        SOPClassUID=SEGMENTATION,
        SOPInstanceUID=generate_uid(),
        Modality="SEG",
        SegmentationType="BINARY",
        Rows=pixels[0].shape[0],
        Columns=pixels[0].shape[1],
        NumberOfFrames=len(frames),
        SamplesPerPixel=1,
        PhotometricInterpretation="MONOCHROME2",
        BitsAllocated=1,
        BitsStored=1,
        HighBit=0,
        PixelRepresentation=0,
        SegmentSequence=Sequence([item(SegmentNumber=n, SegmentLabel=name) for n, name in enumerate(masks, start=1)]),
        SharedFunctionalGroupsSequence=Sequence(
            [
                item(
                    PlaneOrientationSequence=Sequence([item(ImageOrientationPatient=[1, 0, 0, 0, 1, 0])]),
                    PixelMeasuresSequence=Sequence(
                        [item(PixelSpacing=[spacing[1], spacing[0]], SliceThickness=spacing[2])]
                    ),
                )
            ]
        ),
        PerFrameFunctionalGroupsSequence=Sequence(frames),
    )
    data.PixelData = pack_bits(np.stack(pixels).ravel().astype(np.uint8))
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = SEGMENTATION, data.SOPInstanceUID
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.file_meta = meta
    pydicom.dcmwrite(path, data, enforce_file_format=True)
    return path


def edited(file: Path, change: Callable[[Dataset], None]) -> Path:
    """The file, its data set changed."""
    data = pydicom.dcmread(file)
    change(data)
    pydicom.dcmwrite(file, data)
    return file


def as_bytes(data: Dataset, *, kind: str, largest: int, fractional_type: str = "PROBABILITY") -> None:
    """Change a binary segmentation into one of `kind` with a byte a pixel, `largest` inside."""
    data.PixelData = (data.pixel_array * np.uint8(largest)).tobytes()
    data.BitsAllocated = data.BitsStored = 8
    data.HighBit, data.SegmentationType = 7, kind
    if kind == "LABELMAP":
        data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.66.7"
    else:
        data.SegmentationFractionalType, data.MaximumFractionalValue = fractional_type, largest
