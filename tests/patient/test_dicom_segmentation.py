"""DICOM segmentation objects: how frames and segments become one image, and those that are refused."""

import numpy as np
import pydicom
import pytest

from msdm_core.errors import MeshError
from surgsim_apps.patient.label_image import parse_labels, read_label_image
from tests.patient.scans import MIDDLE, check_organ, labels_on
from tests.patient.segmentation_object import item, write_segmentation

BOTH = parse_labels("liver=1,lesion=2")


def segmentation(tmp_path, **options):
    shape, spacing = (40, 36, 20), (2.5, 2.25, 3.5)
    labels = labels_on(np.diag([-1.0, -1.0, 1.0, 1.0]) @ _lps_affine(shape, spacing), shape)
    masks = {"Liver": labels > 0, "Vessel": np.roll(labels == 2, 3, axis=0), "Tumor": labels == 2}
    origin = MIDDLE - (np.array(shape) - 1) / 2 * spacing
    return write_segmentation(tmp_path / "seg.dcm", masks, spacing, origin, **options), labels


def _lps_affine(shape, spacing):
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = MIDDLE - (np.array(shape) - 1) / 2 * spacing
    return affine


def test_dicom_segmentation_with_segments_that_overlap(tmp_path):
    file, labels = segmentation(tmp_path)
    image = read_label_image(file, parse_labels("liver=1,lesion=3"))
    assert np.count_nonzero(image.tags == 2) == np.count_nonzero(labels == 2)
    assert np.count_nonzero(image.tags) == np.count_nonzero(labels)
    check_organ(image, (2.5, 2.25, 3.5))


def test_dicom_segmentation_names_its_segments(tmp_path):
    file, _ = segmentation(tmp_path)
    with pytest.raises(MeshError, match=r"segment 7 is nowhere in it; there are 1 \('Liver'\), 2 \('Vessel'\), 3"):
        read_label_image(file, parse_labels("liver=7"))


def test_sheared_stack_of_dicom_frames_is_refused(tmp_path):
    file, _ = segmentation(tmp_path, shift=0.5)
    with pytest.raises(MeshError, match=r"off an even stack of 3\.5 mm slices: sheared"):
        read_label_image(file, BOTH)


def edited(file, change):
    """The file, its data set changed."""
    data = pydicom.dcmread(file)
    change(data)
    pydicom.dcmwrite(file, data)
    return file


def fractional(data):
    data.SegmentationType = "FRACTIONAL"


def turned_once(data):
    turn = item(ImageOrientationPatient=[0, 1, 0, -1, 0, 0])
    data.PerFrameFunctionalGroupsSequence[0].PlaneOrientationSequence = pydicom.Sequence([turn])


def one_slice_without_thickness(data):
    for frame in data.PerFrameFunctionalGroupsSequence:
        frame.PlanePositionSequence[0].ImagePositionPatient = [0, 0, 0]
    del data.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SliceThickness


def without_segments(data):
    del data.SegmentSequence


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (fractional, "its segments are FRACTIONAL; the rule is BINARY or LABELMAP"),
        (turned_once, "its frames have 2 orientations; the rule is one stack"),
        (one_slice_without_thickness, "has one slice and states no thickness"),
        (without_segments, "cannot be parsed: .*SegmentSequence"),
    ],
)
def test_a_segmentation_that_is_no_stack_of_labels_is_refused(change, words, tmp_path):
    file, _ = segmentation(tmp_path)
    with pytest.raises(MeshError, match=words):
        read_label_image(edited(file, change), BOTH)
