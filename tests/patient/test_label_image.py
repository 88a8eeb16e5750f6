"""Label images read from files: where voxels lie in the patient, and every way a file can be wrong."""

import gzip
import struct

import nibabel
import numpy as np
import pytest
import SimpleITK

from msdm_core.errors import MeshError
from surgsim_apps.patient.label_image import clean_labels, parse_labels, read_label_image
from tests.patient.scans import affine_of, border_notes, check_organ, labels_on, write_nifti

BOTH = parse_labels("liver=1,lesion=2")


def turned(angles):
    """A rotation about z, y and x [radians]."""
    cz, cy, cx = np.cos(angles)
    sz, sy, sx = np.sin(angles)
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return about_z @ about_y @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])


TURNS = {
    "RAS": np.eye(3),
    "LPS": np.diag([-1.0, -1.0, 1.0]),
    "PSR": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "LAS, left-handed": np.diag([-1.0, 1.0, 1.0]),
    "oblique": turned([0.4, -0.3, 0.2]),
}


@pytest.mark.parametrize("name", TURNS)
def test_nifti_lies_in_the_patient_as_its_header_says(name, tmp_path):
    spacing = (2.0, 2.5, 3.0)
    affine, shape = affine_of(spacing, TURNS[name])
    image = read_label_image(write_nifti(tmp_path / "a.nii.gz", labels_on(affine, shape), affine), BOTH)
    np.testing.assert_allclose(image.geometry.spacing, np.array(spacing) * 1e-3, rtol=1e-6)
    assert image.names == ("liver", "lesion")
    check_organ(image, spacing)


@pytest.mark.parametrize(("unit", "scale"), [("meter", 1e-3), ("micron", 1e3)])
def test_the_header_s_length_unit_counts(unit, scale, tmp_path):
    affine, shape = affine_of()
    scaled = np.vstack([affine[:3] * scale, affine[3]])
    image = read_label_image(write_nifti(tmp_path / "a.nii", labels_on(affine, shape), scaled, unit=unit), BOTH)
    check_organ(image, (2.0, 2.0, 2.0))


def test_what_the_header_leaves_open_is_said(tmp_path):
    affine, shape = affine_of()
    image = nibabel.Nifti1Image(labels_on(affine, shape), None)
    image.header.set_zooms((2.0, 2.0, 2.0))
    nibabel.save(image, tmp_path / "a.nii")
    notes = " ".join(read_label_image(tmp_path / "a.nii", BOTH).notes)
    assert "no length unit: millimetres" in notes
    assert "no orientation: left and right" in notes


@pytest.mark.parametrize("suffix", [".nrrd", ".mha", ".dcm"])
def test_what_simpleitk_reads_lies_there_too(suffix, tmp_path):
    affine, shape = affine_of((2.0, 2.0, 3.0))
    labels = labels_on(affine, shape)
    image = SimpleITK.GetImageFromArray(labels.T)
    image.SetSpacing((2.0, 2.0, 3.0))
    # SimpleITK's world is LPS.
    image.SetDirection((-1.0, 0, 0, 0, -1.0, 0, 0, 0, 1.0))
    image.SetOrigin((-affine[0, 3], -affine[1, 3], affine[2, 3]))
    if suffix == ".dcm":
        image = SimpleITK.Cast(image, SimpleITK.sitkUInt16)
    SimpleITK.WriteImage(image, str(tmp_path / f"a{suffix}"))
    image = read_label_image(tmp_path / f"a{suffix}", BOTH)
    if suffix != ".dcm":  # SimpleITK writes no place of a volume's slices into a DICOM file
        check_organ(image, (2.0, 2.0, 3.0))
    assert np.count_nonzero(image.tags) == np.count_nonzero(labels)


DIRECTIONS = "(2,0,0) (0,2,0) (0,0,2)"


def ones_in_nrrd(path, axes):
    text = f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 4 4\n{axes}\nencoding: raw\n\n"
    path.write_bytes(text.encode() + bytes([1] * 64))
    return path


@pytest.mark.parametrize(
    "axes",
    [
        "spacings: 2 2 2",
        f"space dimension: 3\nspace directions: {DIRECTIONS}",
        f"space: 3D-right-handed\nspace directions: {DIRECTIONS}",
    ],
)
def test_nrrd_without_an_anatomical_space_says_what_is_taken(axes, tmp_path):
    ones_in_nrrd(tmp_path / "a.nrrd", axes)
    image = read_label_image(tmp_path / "a.nrrd", parse_labels("liver=1"))
    assert "names no anatomical space" in " ".join(image.notes)


@pytest.mark.parametrize(
    ("stored", "scale", "largest"),
    [
        (np.uint16, 1.0, 3),
        (np.int16, 1.0, 3),
        (np.uint8, 1.0, 7),
        (np.uint8, 1.0, 200),
        (np.float32, 1.0 - 2e-7, 3),
        (np.float32, 1.0 + 3e-4, 3),
        (np.float32, 1.0 - 2e-7, 11101),
    ],
)
def test_labels_stored_with_a_slope_or_rounded_are_the_array_s(stored, scale, largest, tmp_path):
    """nibabel scales float64 onto the whole range of an integer type: 1 beside 7 becomes 0.988 as a byte."""
    affine, shape = affine_of()
    labels = labels_on(affine, shape)
    image = nibabel.Nifti1Image(np.where(labels == 2, float(largest), labels) * scale, affine)
    image.set_data_dtype(stored)
    nibabel.save(image, tmp_path / "a.nii.gz")
    # The second label is apart from the first, for the type's range.
    read = read_label_image(tmp_path / "a.nii.gz", parse_labels(f"liver=1,lesion={largest}"))
    assert np.bincount(read.tags.ravel())[1:].tolist() == np.bincount(labels.ravel())[1:].tolist()
    assert any("rounded" in note for note in read.notes)


@pytest.mark.parametrize(("stored", "largest"), [(np.uint8, 3), (np.float32, 3), (np.uint8, 300)])
def test_partial_volumes_and_labels_closer_than_a_slope_are_refused(stored, largest, tmp_path):
    affine, shape = affine_of((4.0, 4.0, 4.0))
    labels = labels_on(affine, shape)
    values = np.where(labels == 2, float(largest), labels)
    values[0, 0, :2] = 0.113, 0.341
    image = nibabel.Nifti1Image(values, affine)
    image.set_data_dtype(stored)
    nibabel.save(image, tmp_path / "a.nii")
    refused(tmp_path / "a.nii", "no whole number")


def test_negative_labels(tmp_path):
    affine, shape = affine_of((4.0, 4.0, 4.0))
    labels = labels_on(affine, shape).astype(np.int8)
    file = write_nifti(tmp_path / "a.nii", np.where(labels == 2, -1, labels).astype(np.int8), affine)
    image = read_label_image(file, parse_labels("liver=1,lesion=-1"))
    assert np.count_nonzero(image.tags == 2) == np.count_nonzero(labels == 2)


@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd", ".mha"])
@pytest.mark.parametrize(
    ("cut", "cropped", "notes"), [(1.0, True, 0), (0.5, False, 1), (0.5, True, 1), (0.8, False, 1)]
)
def test_an_organ_cut_off_is_said_and_one_cropped_to_is_not(suffix, cut, cropped, notes, tmp_path):
    affine, shape = affine_of()
    labels = labels_on(affine, shape)[..., : int(cut * shape[2])]
    if cropped:
        labels = labels[tuple(slice(used.min(), used.max() + 1) for used in np.nonzero(labels))]
    image = SimpleITK.GetImageFromArray(np.ascontiguousarray(labels.T))
    image.SetSpacing((2.0, 2.0, 2.0))
    SimpleITK.WriteImage(image, str(tmp_path / f"a{suffix}"))
    read = read_label_image(tmp_path / f"a{suffix}", BOTH if labels.max() == 2 else parse_labels("liver=1"))
    found = border_notes(clean_labels(read, cell_size=0.006, mend=False).notes)
    assert len(found) == notes
    # The area of the last slice, of pixels of 0.04 cm^2.
    assert all("head" in note and f"{np.count_nonzero(labels[..., -1]) * 0.04:.3g} cm^2" in note for note in found)


@pytest.mark.parametrize("place", [float("nan"), float("inf")])
def test_an_origin_that_is_no_place_is_refused(place, tmp_path):
    header = bytearray(plain(tmp_path / "a.nii").read_bytes())
    header[280 + 12 : 280 + 16] = struct.pack("<f", place)  # srow_x[3]
    (tmp_path / "a.nii").write_bytes(header)
    refused(tmp_path / "a.nii", f"origin is .*{place}")


def two_forms(path, sform, qform, pixdim=None):
    affine, shape = affine_of()
    image = nibabel.Nifti1Image(labels_on(affine, shape), None)
    image.set_sform(sform, 1)
    image.set_qform(qform, int(pixdim is None))
    if pixdim is not None:
        image.header["pixdim"][1:4] = pixdim
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)
    return read_label_image(path, BOTH).notes, np.array(shape)


def test_two_statements_of_a_nifti_header_are_compared(tmp_path):
    affine, _ = affine_of((2.0, 2.0, 2.5))
    assert two_forms(tmp_path / "same.nii", affine, affine)[0] == ()
    flipped = affine @ np.diag([-1.0, -1.0, 1.0, 1.0])
    flipped[:3, 3] += 5.0, 6.0, 7.0
    (note,), shape = two_forms(tmp_path / "flipped.nii", affine, flipped)
    # Voxel (i, j, k) lies (-4 i + 5, -4 j + 6, 7) mm away: farthest at the last.
    assert f"{np.hypot(np.hypot(5 - 4 * (shape[0] - 1), 6 - 4 * (shape[1] - 1)), 7):.4g} mm" in note
    (note,), shape = two_forms(tmp_path / "spacing.nii", affine, affine, (2.0, 2.0, 1.25))
    assert f"{1.25 * (shape[2] - 1):.4g} mm" in note


SEGMENTS = "".join(
    f"Segment{number}_Name:={name}\nSegment{number}_ID:=Segment_{number + 1}\nSegment{number}_LabelValue:=%d\n"
    f"Segment{number}_Layer:=%d\n"
    for number, name in enumerate(["Liver", "Tumour"])
)


def write_nrrd(path, values, layers, kinds, sizes, segments):
    text = (
        f"NRRD0004\ntype: uint8\ndimension: {len(values.shape)}\nspace: left-posterior-superior\nsizes: {sizes}\n"
        f"space directions: {layers} (2,0,0) (0,2,0) (0,0,2)\nkinds: {kinds}\nencoding: raw\n"
        f"space origin: (0,0,0)\n{segments}\n"
    )
    path.write_bytes(text.encode() + values.tobytes(order="F"))
    return path


@pytest.mark.parametrize(
    "axes",
    ["spacings: 2 2 2\nunits:", f"space: LPS\nspace directions: {DIRECTIONS}\nspace units:"],
)
@pytest.mark.parametrize(
    ("units", "spacing", "words"),
    [
        (["cm"] * 3, 0.02, ""),
        (["mm"] * 3, 0.002, ""),
        ([""] * 3, 0.002, ""),
        (["m"] * 3, None, "2000 x 2000 x 2000 mm"),
        (["mm", "cm", "mm"], None, "cm, mm"),
        (["inch"] * 3, None, "inch"),
    ],
)
def test_units_of_an_nrrd_file(axes, units, spacing, words, tmp_path):
    file = ones_in_nrrd(tmp_path / "a.nrrd", f"{axes} " + " ".join(f'"{unit}"' for unit in units))
    if spacing is None:
        refused(file, words)
    else:
        assert read_label_image(file).geometry.spacing == pytest.approx(spacing)


@pytest.mark.parametrize(
    ("numbers", "chosen"), [((1, 1), ("Liver", "Tumour")), ((1, 1), ("Segment0", "Segment_2")), ((1, 2), (1, 2))]
)
def test_layers_of_3d_slicer_s_segments(numbers, chosen, tmp_path):
    affine, shape = affine_of()
    labels = labels_on(affine, shape)
    layers = np.stack([(labels > 0) * numbers[0], (labels == 2) * numbers[1]]).astype(np.uint8)
    segments = SEGMENTS % (numbers[0], 0, numbers[1], 1)
    sizes = " ".join(map(str, layers.shape))
    file = write_nrrd(tmp_path / "a.seg.nrrd", layers, "none", "list domain domain domain", sizes, segments)
    image = read_label_image(file, parse_labels("liver={},lesion={}".format(*chosen)))
    assert np.bincount(image.tags.ravel())[1:].tolist() == np.bincount(labels.ravel())[1:].tolist()
    if numbers == (1, 1):
        refused(file, "Liver: layer 0, value 1; Tumour: layer 1, value 1")
    refused(file, "Liver: layer 0, value 1; Tumour: layer 1", parse_labels("liver=9"))
    beyond = write_nrrd(
        tmp_path / "b.nrrd", layers, "none", "list domain domain domain", sizes, SEGMENTS % (1, 0, 1, 2)
    )
    refused(beyond, "Tumour.* is nowhere", parse_labels("liver=Liver,lesion=Tumour"))


def test_a_segment_without_voxels_is_not_listed_and_does_not_count(tmp_path):
    layers = np.zeros((2, 6, 6, 6), np.uint8)
    layers[0, 2:4, 2:4, 2:4] = 1
    file = write_nrrd(
        tmp_path / "a.nrrd", layers, "none", "list domain domain domain", "2 6 6 6", SEGMENTS % (1, 0, 1, 1)
    )
    assert np.count_nonzero(read_label_image(file).tags) == 8
    refused(file, "there are labels Liver: layer 0, value 1: correct", parse_labels("liver=Tumour"))


def test_equal_names_in_a_file_leave_the_numbers(tmp_path):
    segments = SEGMENTS.replace("Tumour", "Liver") % (1, 0, 2, 0)
    values = np.ones((4, 4, 4), np.uint8)
    values[1:3] = 2
    file = write_nrrd(tmp_path / "a.nrrd", values, "", "domain domain domain", "4 4 4", segments)
    refused(file, r"1 \(Liver\); 2 \(Liver\)\): choose by number", parse_labels("liver=Liver"))
    assert np.bincount(read_label_image(file, BOTH).tags.ravel()).tolist() == [0, 32, 32]


def test_names_of_labels_in_the_file_are_listed_and_taken(tmp_path):
    affine, shape = affine_of((4.0, 4.0, 4.0))
    labels = labels_on(affine, shape)
    sizes = " ".join(map(str, shape))
    nrrd = write_nrrd(tmp_path / "a.nrrd", labels, "", "domain domain domain", sizes, SEGMENTS % (1, 0, 2, 0))
    # As TotalSegmentator writes it.
    entries = "".join(
        f'<Label Key="{key}" Red="1"><![CDATA[{name}]]></Label>' for key, name in ((1, "Liver"), (2, "Tumour"))
    )
    table = (
        f'<?xml version="1.0" encoding="UTF-8"?> <CaretExtension><LabelTable>{entries}</LabelTable></CaretExtension>'
    )
    image = nibabel.Nifti1Image(labels, affine)
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, table.encode()))
    nibabel.save(image, tmp_path / "a.nii.gz")
    for file in (nrrd, tmp_path / "a.nii.gz"):
        refused(file, r"1 \(Liver\), 2 \(Tumour\)", parse_labels("liver=5"))
        refused(file, r"'liver'.* 1 \(Liver\), 2 \(Tumour\)", parse_labels("liver=liver"))
        read = read_label_image(file, parse_labels("liver=Liver,lesion=Tumour"))
        assert np.count_nonzero(read.tags == 2) == np.count_nonzero(labels == 2)


@pytest.mark.parametrize("hollow", [True, False])
@pytest.mark.parametrize("text", [None, "liver=1,liver_tumor=1"])
def test_a_file_for_each_tissue(hollow, text, tmp_path):
    """The lesions are their file's, whether the organ's file has them, too, or not."""
    affine, shape = affine_of()
    labels = labels_on(affine, shape)
    organ = write_nifti(
        tmp_path / "liver.nii.gz", ((labels == 1) | (not hollow) & (labels > 0)).astype(np.uint8), affine
    )
    lesion = write_nifti(tmp_path / "liver_tumor.nii.gz", (labels == 2).astype(np.uint8), affine)
    image = read_label_image(organ, parse_labels(text, file_count=2) if text else None, others=[lesion])
    assert image.names == ("liver", "liver_tumor")
    assert np.bincount(image.tags.ravel())[1:].tolist() == np.bincount(labels.ravel())[1:].tolist()
    check_organ(image, (2.0, 2.0, 2.0))
    assert len(image.notes) == int(not hollow)


def test_files_on_other_grids_and_of_several_labels_are_refused(tmp_path):
    affine, shape = affine_of((4.0, 4.0, 4.0))
    labels = labels_on(affine, shape)
    first = write_nifti(tmp_path / "liver.nii.gz", (labels > 0).astype(np.uint8), affine)
    moved, coarse = affine.copy(), affine @ np.diag([2.0, 2.0, 2.0, 1.0])
    moved[1, 3] += 3.0
    wrong = {
        "both": (labels, affine, r"labels 1, 2"),
        "moved": ((labels == 2) * 1, moved, "3 mm apart"),
        "coarse": ((labels == 2)[::2, ::2, ::2] * 1, coarse, "8 x 8 x 8 mm"),
    }
    for name, (values, matrix, words) in wrong.items():
        file = write_nifti(tmp_path / f"{name}.nii.gz", values.astype(np.uint8), matrix)
        with pytest.raises(MeshError, match=words):
            read_label_image(first, others=[file])
    (tmp_path / "b").mkdir()
    second = write_nifti(tmp_path / "b" / "liver.nii.gz", (labels == 2).astype(np.uint8), affine)
    with pytest.raises(MeshError, match=r"'liver' is given twice; rename a file"):
        read_label_image(first, others=[second])
    with pytest.raises(MeshError, match=r"1 labels .* 2 files"):
        parse_labels("liver=1", file_count=2)


# ---- files that are wrong ---------------------------------------------------------------------------------------


def plain(path):
    affine, shape = affine_of((4.0, 4.0, 4.0))
    return write_nifti(path, labels_on(affine, shape), affine)


def refused(file, words, labels=BOTH):
    with pytest.raises(MeshError, match=words) as caught:
        read_label_image(file, labels)
    assert file.name in str(caught.value)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
@pytest.mark.parametrize("share", [0.01, 0.95])
def test_a_file_that_was_cut_short(name, share, tmp_path):
    whole = plain(tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: int(share * len(whole))])
    refused(tmp_path / name, "cannot be parsed")


def test_four_axes_shear_and_numbers_that_are_no_labels(tmp_path):
    affine, shape = affine_of((4.0, 4.0, 4.0))
    labels = labels_on(affine, shape)
    refused(write_nifti(tmp_path / "4d.nii", np.stack([labels, labels], axis=-1), affine), r"4 axes \(.* x 2\)")
    read_label_image(write_nifti(tmp_path / "ok.nii", labels[..., None], affine), BOTH)
    sheared = affine.copy()
    sheared[0, 2] = 1.0
    refused(write_nifti(tmp_path / "shear.nii", labels, sheared), r"axes 0 and 2 .*75.96 degrees; sheared")
    refused(write_nifti(tmp_path / "float.nii", labels * 0.5, affine), "holds 0.5, which is no whole number")
    read_label_image(write_nifti(tmp_path / "whole.nii", labels.astype(np.float32), affine), BOTH)
    refused(write_nifti(tmp_path / "far.nii", labels, affine * 100), "voxels are 400 x 400 x 400 mm")
    header = bytearray(plain(tmp_path / "flat.nii").read_bytes())
    header[280 + 4 : 280 + 8] = struct.pack("<f", float("nan"))  # srow_x[1]
    (tmp_path / "flat.nii").write_bytes(header)
    refused(tmp_path / "flat.nii", "voxels are .* nan")


def test_a_label_that_is_not_there_and_an_image_without_any(tmp_path):
    file = plain(tmp_path / "a.nii.gz")
    refused(file, r"label 5 \('liver'\) is nowhere in the image; there are labels 1, 2", parse_labels("liver=5"))
    affine, shape = affine_of((4.0, 4.0, 4.0))
    refused(write_nifti(tmp_path / "0.nii", np.zeros(shape, np.uint8), affine), "no labels at all, every voxel is 0")


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".nrrd", ".mha", ".dcm"])
@pytest.mark.parametrize("data", [b"", b"solid cube\n" * 50])
def test_rubbish_is_one_error(suffix, data, tmp_path):
    (tmp_path / f"a{suffix}").write_bytes(data)
    refused(tmp_path / f"a{suffix}", "empty|cannot be parsed")


def test_a_compressed_file_under_the_name_of_a_plain_one(tmp_path):
    file = plain(tmp_path / "a.nii")
    file.write_bytes(gzip.compress(file.read_bytes()))
    refused(file, r"a\.nii\.gz")


def test_no_file_and_a_folder(tmp_path):
    refused(tmp_path / "none.nii", "no such file")
    (tmp_path / "folder.nii").mkdir()
    refused(tmp_path / "folder.nii", "no such file")


def test_voxels_of_several_numbers(tmp_path):
    SimpleITK.WriteImage(SimpleITK.Image([4, 4, 4], SimpleITK.sitkVectorUInt8, 3), str(tmp_path / "rgb.nrrd"))
    refused(tmp_path / "rgb.nrrd", "each voxel has 3 numbers; the rule is one label")


@pytest.mark.parametrize("kind", [[("R", "u1"), ("G", "u1"), ("B", "u1")], np.complex64])
def test_colours_and_complex_numbers_are_no_labels(kind, tmp_path):
    nibabel.save(nibabel.Nifti1Image(np.zeros((9, 9, 9), dtype=kind), np.eye(4)), tmp_path / "a.nii")
    refused(tmp_path / "a.nii", "the image's values are .*; labels are whole numbers")


def test_both_versions_and_byte_orders_of_nifti(tmp_path):
    affine, shape = affine_of((4.0, 4.0, 4.0))
    labels = labels_on(affine, shape).astype(np.int16)
    second = nibabel.Nifti2Image(labels, affine)
    second.header.set_xyzt_units("mm")
    nibabel.save(second, tmp_path / "second.nii")
    header = nibabel.Nifti1Header(endianness=">")
    header.set_data_dtype(">i2")
    header.set_xyzt_units("mm")
    nibabel.save(nibabel.Nifti1Image(labels, affine, header), tmp_path / "big.nii.gz")
    for name in ("second.nii", "big.nii.gz"):
        check_organ(read_label_image(tmp_path / name, BOTH), (4.0, 4.0, 4.0))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("liver", "'liver' is no NAME=LABEL"),
        ("liver=1,", "'' is no NAME=LABEL"),
        ("liver=", "no NAME=LABEL"),
        ("liver=0", "0 is outside"),
        ("liver=1,liver=2", "'liver' is given twice"),
        ("liver=1,lesion=1", "1 is given twice"),
        ('li"ver=1', "cannot be a region's name"),
        ("=1", "cannot be a region's name"),
    ],
)
def test_labels_that_make_no_sense(text, words):
    with pytest.raises(MeshError, match=words):
        parse_labels(text)


def test_labels_are_read_in_order():
    assert [(label.name, label.value) for label in parse_labels("left kidney = 7 ,lesion=2")] == [
        ("left kidney", 7),
        ("lesion", 2),
    ]
