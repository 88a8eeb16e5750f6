"""Label images read from files: where voxels lie in the patient, and every way a file can be wrong."""

import struct

import nibabel
import numpy as np
import pytest
import SimpleITK

from msdm_core.errors import MeshError
from surgsim_apps.patient.label_image import parse_labels, read_label_image
from tests.patient.scans import affine_of, check_organ, labels_on, write_nifti

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


def test_nrrd_without_a_space_says_what_is_taken(tmp_path):
    (tmp_path / "a.nrrd").write_bytes(
        b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 4 4\nspacings: 2 2 2\nencoding: raw\n\n" + bytes([1] * 64)
    )
    image = read_label_image(tmp_path / "a.nrrd", parse_labels("liver=1"))
    assert "names no anatomical space" in " ".join(image.notes)


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
        ("liver=one", "no NAME=LABEL"),
        ("liver=-1", "no NAME=LABEL"),
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
