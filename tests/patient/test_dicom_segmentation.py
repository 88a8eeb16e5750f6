"""DICOM segmentation objects: how frames and segments become one image, and those that are refused."""

from functools import partial

import numpy as np
import pydicom
import pytest

from msdm_core.errors import MeshError
from surgsim_apps.patient.label_image import clean_labels, parse_labels, read_label_image
from tests.patient.scans import MIDDLE, border_notes, check_organ, labels_on
from tests.patient.segmentation_object import as_bytes, edited, item, write_segmentation

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
    assert f"{np.count_nonzero(labels == 2)} voxels" in " ".join(image.notes)
    named = read_label_image(file, parse_labels("liver=Liver,lesion=Tumor"))
    np.testing.assert_array_equal(named.tags, image.tags)
    # The organ's segment holds the lesions' whole one, which is there.
    with pytest.raises(MeshError, match=r"3 \('lesion'\) is covered wholly by .* 1 \('liver'\)"):
        read_label_image(file, parse_labels("lesion=3,liver=1"))


def test_dicom_segmentation_names_its_segments(tmp_path):
    file, _ = segmentation(tmp_path)
    with pytest.raises(MeshError, match=r"7 .* 1 \(Liver\), 2 \(Vessel\), 3 \(Tumor\)"):
        read_label_image(file, parse_labels("liver=7"))


def test_sheared_stack_of_dicom_frames_is_refused(tmp_path):
    file, _ = segmentation(tmp_path, shift=0.5)
    with pytest.raises(MeshError, match=r"off an even stack of 3\.5 mm slices: sheared"):
        read_label_image(file, BOTH)


@pytest.mark.parametrize("kind", ["BINARY", "LABELMAP", "FRACTIONAL"])
@pytest.mark.parametrize(("share", "notes"), [(1.0, 0), (0.5, 1)])
def test_frames_left_out_because_they_are_empty_do_not_cut_the_organ(kind, share, notes, tmp_path):
    """All frames without voxels of the organ are left out; half of an organ is cut off at its middle alone."""
    shape, spacing = (50, 40, 34), (2.5, 2.5, 2.0)
    mask = labels_on(np.diag([-1.0, -1.0, 1.0, 1.0]) @ _lps_affine(shape, spacing), shape) > 0
    mask[..., int(share * shape[2]) :] = False
    file = write_segmentation(tmp_path / "a.dcm", {"Liver": mask}, spacing, (0.0, 0.0, 0.0))
    if kind != "BINARY":
        edited(file, partial(as_bytes, kind=kind, largest=1))
    image = read_label_image(file, parse_labels("liver=1"))
    assert np.count_nonzero(image.tags) == np.count_nonzero(mask)
    found = border_notes(clean_labels(image, cell_size=0.006, mend=False).notes)
    assert len(found) == notes
    assert all("head" in note for note in found)


@pytest.mark.parametrize("fractional_type", ["PROBABILITY", "OCCUPANCY"])
@pytest.mark.parametrize("largest", [255, 100])
def test_fractions_count_from_half_of_the_maximum_on(fractional_type, largest, tmp_path):
    file, labels = segmentation(tmp_path)
    edited(file, partial(as_bytes, kind="FRACTIONAL", largest=largest, fractional_type=fractional_type))

    def graded(data):
        """Half of the maximum, rounded up, in lesions' frames, and just below half outside of all segments."""
        pixels = data.pixel_array
        pixels[pixels == 0] = (largest - 1) // 2
        pixels[-5:][pixels[-5:] == largest] = (largest + 1) // 2
        data.PixelData = pixels.tobytes()

    image = read_label_image(edited(file, graded), parse_labels("liver=1,lesion=3"))
    assert np.count_nonzero(image.tags) == np.count_nonzero(labels)
    assert np.count_nonzero(image.tags == 2) == np.count_nonzero(labels == 2)
    assert any(fractional_type in note and str(largest) in note for note in image.notes)


@pytest.mark.parametrize(("largest", "most"), [(1, 255), (127, 255), (255, 100), (255, 0)])
def test_fractions_without_a_half_of_their_maximum_or_above_it_are_refused(largest, most, tmp_path):
    file, _ = segmentation(tmp_path)

    def stated(data):
        as_bytes(data, kind="FRACTIONAL", largest=largest)
        data.MaximumFractionalValue = most

    with pytest.raises(MeshError, match=f"of {most}, .* largest value is {largest}"):
        read_label_image(edited(file, stated), parse_labels("liver=1"))


@pytest.mark.parametrize("number", [1, 9])
def test_a_label_map_holds_the_labels_of_its_voxels(number, tmp_path):
    """The background is no label, although it has a segment; a number without a segment is a label."""
    mask = np.zeros((30, 30, 3), dtype=bool)
    mask[5:25, 5:25] = True
    file = write_segmentation(tmp_path / "a.dcm", {"Liver": mask}, (2.0, 2.0, 2.0), (0.0, 0.0, 0.0))

    def with_background(data):
        as_bytes(data, kind="LABELMAP", largest=number)
        data.SegmentSequence.insert(0, item(SegmentNumber=0, SegmentLabel="Background"))

    edited(file, with_background)
    assert np.count_nonzero(read_label_image(file).tags) == 1200
    with pytest.raises(MeshError, match=rf"'liver'.* labels {number}( \(Liver\))?: "):
        read_label_image(file, parse_labels("liver=Background"))


@pytest.mark.parametrize(
    ("places", "spacing", "thickness", "slices", "noted"),
    [
        ((20, 22, 24), 2, 2, 3, ()),
        ((20, 22, 26), 2, 2, 3, ()),  # An empty slice in between.
        ((24, 20, 22), 2, 5, 3, ()),  # Slices that overlap, in another order.
        ((20, 26), 2, 2, 2, ("6 mm", "2 mm")),
        ((20, 26, 30), 2, 2, 3, ("4 mm", "2 mm")),
        ((20, 25, 30, 35), 2, 2, 4 * 2.5, ("5 mm", "2 mm")),  # No multiple: the positions.
        ((20, 22, 24), 3, 3, 3, ("2 mm", "3 mm")),
        ((20, 25, 30), 1, 5, 3 * 2.5, ("5 mm", "1 mm")),  # Positions and thickness agree.
        ((20, 26), None, 2, 2 * 3, ("6 mm", "2 mm")),
        ((20, 26, 32), 2, 2, None, ("6 mm", "2 mm")),
    ],
)
def test_spacing_of_slices_by_the_frames_and_by_the_header(places, spacing, thickness, slices, noted, tmp_path):
    """Squares of 400 pixels of 4 mm^2; `slices` of 2 mm, or None for a refusal."""
    mask = np.zeros((30, 30, len(places)), dtype=bool)
    mask[5:25, 5:25] = True
    file = write_segmentation(tmp_path / "a.dcm", {"Liver": mask}, (2.0, 2.0, 2.0), (0.0, 0.0, 0.0))

    def placed(data):
        measures = data.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0]
        measures.SliceThickness = thickness
        if spacing is not None:
            measures.SpacingBetweenSlices = spacing
        for frame, place in zip(data.PerFrameFunctionalGroupsSequence, places, strict=True):
            frame.PlanePositionSequence[0].ImagePositionPatient = [0, 0, place]

    edited(file, placed)
    if slices is None:
        with pytest.raises(MeshError, match=".*".join(noted)):
            read_label_image(file, parse_labels("liver=1"))
        return
    image = read_label_image(file, parse_labels("liver=1"))
    np.testing.assert_allclose(np.count_nonzero(image.tags) * image.voxel_volume, slices * 3.2e-6, rtol=1e-9)
    assert len(image.notes) == bool(noted)
    assert all(length in image.notes[0] for length in noted)


def test_frames_whose_headers_differ_by_rounding(tmp_path):
    file, labels = segmentation(tmp_path)

    def rounded(data):
        frame = data.PerFrameFunctionalGroupsSequence[0]
        frame.PlaneOrientationSequence = pydicom.Sequence([item(ImageOrientationPatient=[1, 1e-7, 0, -1e-7, 1, 0])])
        measures = item(PixelSpacing=[2.250001, 2.499999], SliceThickness=3.5)
        frame.PixelMeasuresSequence = pydicom.Sequence([measures])

    image = read_label_image(edited(file, rounded), parse_labels("liver=1,lesion=3"))
    assert np.count_nonzero(image.tags) == np.count_nonzero(labels)


def turned_once(data):
    turn = item(ImageOrientationPatient=[0, 1, 0, -1, 0, 0])
    data.PerFrameFunctionalGroupsSequence[0].PlaneOrientationSequence = pydicom.Sequence([turn])


def one_slice_without_thickness(data):
    for frame in data.PerFrameFunctionalGroupsSequence:
        frame.PlanePositionSequence[0].ImagePositionPatient = [0, 0, 0]
    del data.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SliceThickness


def of_another_type(data):
    data.SegmentationType = "OTHER"


def without_segments(data):
    del data.SegmentSequence


def projection(data):
    for frame in data.PerFrameFunctionalGroupsSequence:
        del frame.PlanePositionSequence


def tiled_full(data):
    del data.PerFrameFunctionalGroupsSequence


def without_voxels(data):
    data.SOPClassUID = "1.2.840.10008.5.1.4.1.1.481.3"
    del data.PixelData


def frame_twice(data):
    frames = data.PerFrameFunctionalGroupsSequence
    frames[1] = frames[0]


def pixels_of_two_sizes(data):
    measures = item(PixelSpacing=[3.0, 3.0], SliceThickness=3.5)
    data.PerFrameFunctionalGroupsSequence[0].PixelMeasuresSequence = pydicom.Sequence([measures])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (of_another_type, "OTHER"),
        (projection, "no place in the patient"),
        (tiled_full, "no place in the patient"),
        (without_voxels, r"no voxels \(RT Structure Set Storage\)"),
        (frame_twice, "repeat a slice"),
        (pixels_of_two_sizes, "2 pixel sizes"),
        (turned_once, "its frames have 2 orientations; the rule is one stack"),
        (one_slice_without_thickness, "has one slice and states no thickness"),
        (without_segments, "cannot be parsed: .*SegmentSequence"),
    ],
)
def test_a_segmentation_that_is_no_stack_of_labels_is_refused(change, words, tmp_path):
    file, _ = segmentation(tmp_path)
    with pytest.raises(MeshError, match=words):
        read_label_image(edited(file, change), BOTH)
