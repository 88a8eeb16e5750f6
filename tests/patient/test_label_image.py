"""Label images read from files: where voxels lie in the patient, and every way a file can be wrong."""

import gzip
import struct
import tracemalloc
import warnings

import nibabel
import numpy as np
import pytest
import SimpleITK

from msdm_core.errors import MeshError
from surgsim_env.patient.label_image import parse_labels, read_label_image
from surgsim_env.patient.label_readers import RUN_VOXELS, VOXELS_MOST
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
    found = read_label_image(tmp_path / f"a{suffix}", BOTH)
    if suffix != ".dcm":  # SimpleITK writes no place of a volume's slices into a DICOM file
        check_organ(found, (2.0, 2.0, 3.0))
    assert np.count_nonzero(found.tags) == np.count_nonzero(labels)


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
@pytest.mark.parametrize("share", [0.01, 0.3, 0.95])
def test_a_file_that_was_cut_short(name, share, tmp_path):
    whole = plain(tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: int(share * len(whole))])
    refused(tmp_path / name, "cut short|cannot be parsed")


def test_a_file_that_is_compressed_otherwise_than_it_is_named(tmp_path):
    data = plain(tmp_path / "a.nii").read_bytes()
    (tmp_path / "b.nii.gz").write_bytes(data)
    refused(tmp_path / "b.nii.gz", r"is named \.nii\.gz and is not compressed")
    (tmp_path / "c.nii").write_bytes(gzip.compress(data))
    refused(tmp_path / "c.nii", r"is named \.nii and is compressed")


def test_compressed_data_with_a_wrong_bit(tmp_path):
    data = bytearray(plain(tmp_path / "a.nii.gz").read_bytes())
    data[-7] ^= 1  # in the checksum
    (tmp_path / "a.nii.gz").write_bytes(data)
    refused(tmp_path / "a.nii.gz", "cannot be parsed: .*CRC")


def test_a_file_that_goes_on_after_its_image(tmp_path):
    data = plain(tmp_path / "a.nii").read_bytes()
    (tmp_path / "b.nii.gz").write_bytes(gzip.compress(data + bytes(3_000_000)))
    refused(tmp_path / "b.nii.gz", "goes on far beyond")


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
    flat = affine.copy()
    flat[:, 1] = 0.0
    header = bytearray(plain(tmp_path / "flat.nii").read_bytes())
    header[280 + 4 : 280 + 8] = struct.pack("<f", float("nan"))  # srow_x[1]
    (tmp_path / "flat.nii").write_bytes(header)
    refused(tmp_path / "flat.nii", "not finite")


def test_a_label_that_is_not_there_and_an_image_without_any(tmp_path):
    file = plain(tmp_path / "a.nii.gz")
    refused(file, r"label 5 \('liver'\) is nowhere in the image; there are labels 1, 2", parse_labels("liver=5"))
    affine, shape = affine_of((4.0, 4.0, 4.0))
    refused(write_nifti(tmp_path / "0.nii", np.zeros(shape, np.uint8), affine), "no labels at all, every voxel is 0")


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".nrrd", ".mha", ".dcm"])
@pytest.mark.parametrize("data", [b"", b"\x1f\x8b\x08rubbish", b"solid cube\n" * 50, bytes(range(256)) * 20])
def test_rubbish_is_one_error(suffix, data, tmp_path):
    (tmp_path / f"a{suffix}").write_bytes(data)
    refused(tmp_path / f"a{suffix}", "empty|cannot be parsed|compressed|unable|is no")


def test_no_file_and_a_folder(tmp_path):
    refused(tmp_path / "none.nii", "no such file")
    (tmp_path / "folder.nii").mkdir()
    refused(tmp_path / "folder.nii", "is a directory")


def test_voxels_of_several_numbers_and_too_many_bytes_for_itk(tmp_path, monkeypatch):
    SimpleITK.WriteImage(SimpleITK.Image([4, 4, 4], SimpleITK.sitkVectorUInt8, 3), str(tmp_path / "rgb.nrrd"))
    refused(tmp_path / "rgb.nrrd", "each voxel has 3 numbers; the rule is one label")
    SimpleITK.WriteImage(SimpleITK.Image([4, 5, 6], SimpleITK.sitkInt16), str(tmp_path / "big.nrrd"))
    # Two bytes a voxel for the image, one for the labels in it.
    monkeypatch.setattr("surgsim_env.patient.label_readers.IMAGE_BYTES_MOST", 3 * 4 * 5 * 6 - 1)
    refused(tmp_path / "big.nrrd", r"holds 4 x 5 x 6 voxels of 2 bytes, which take .*; at most .* are read at once")


def test_a_huge_image_is_refused_by_its_header(tmp_path):
    header = nibabel.Nifti1Header()
    header.set_data_shape((32000, 32000, 2000))
    header.set_data_dtype(np.uint8)
    header["magic"], header["vox_offset"] = b"n+1", 352
    header.set_sform(np.diag([1.0, 1.0, 1.0, 1.0]), code=1)
    (tmp_path / "a.nii").write_bytes(header.binaryblock + bytes(1000))
    refused(tmp_path / "a.nii", r"2\.05e\+12 voxels; at most 1e\+09")
    assert VOXELS_MOST == 1_000_000_000
    (tmp_path / "a.nrrd").write_bytes(
        b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 32000 32000 2000\nspacings: 1 1 1\nencoding: raw\n\n" + bytes(9)
    )
    refused(tmp_path / "a.nrrd", "at most 1e[+]09 are read|cannot be parsed")


def test_labels_that_reach_too_far_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("surgsim_env.patient.label_image.BOX_VOXELS_MOST", 100)
    refused(plain(tmp_path / "a.nii"), r"the labels reach over \d+ x \d+ x \d+ = .* voxels; at most 100")


def memory_of(read):
    """What a call returns, and the most memory it took [bytes]."""
    tracemalloc.start()
    try:
        return read(), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("shape", [(256, 256, 120), (4000, 2000, 1), (30000, 250, 1)])
def test_memory_is_a_byte_a_voxel_and_some_runs(shape, tmp_path):
    labels = np.zeros(shape, dtype=np.float64)
    labels[100:150, 100:150, 40 % shape[2] : 80] = 1
    file = write_nifti(tmp_path / "a.nii.gz", labels, np.diag([1.0, 1.0, 1.0, 1.0]))
    size = labels.size
    del labels
    image, peak = memory_of(lambda: read_label_image(file, parse_labels("liver=1")))
    assert image.tags.shape == (50, 50, min(40, shape[2]))
    # As they lie in the file they have 8 bytes a voxel, 64 MB; of runs there are two and what comparing takes.
    assert peak < size + 3.5 * 8 * RUN_VOXELS


def with_extension(path, esize, *, room, vox_offset=None):
    """A plain image after a header extension that says it has `esize` bytes and has `room`."""
    data = plain(path.with_name("plain.nii")).read_bytes()
    header = bytearray(data[:352])
    header[348] = 1
    header[108:112] = struct.pack("<f", 360 + room if vox_offset is None else vox_offset)
    head = bytes(header) + struct.pack("<ii", esize, 6) + bytes(room)
    path.write_bytes(gzip.compress(head + data[352:], 1))
    return path


@pytest.mark.parametrize("esize", [64, 2**31 - 16, -8, 8])
def test_a_header_extension_is_passed_over_whatever_it_says_of_its_size(esize, tmp_path):
    image = read_label_image(with_extension(tmp_path / "a.nii.gz", esize, room=56), BOTH)
    check_organ(image, (4.0, 4.0, 4.0))


def test_a_long_header_extension_is_refused_unread(tmp_path):
    file = with_extension(tmp_path / "a.nii.gz", 50_000_008, room=50_000_000)
    _, peak = memory_of(lambda: refused(file, r"first voxel at byte 50000360 \(vox_offset\); the rule is 0 to 1000000"))
    assert peak < 5_000_000
    below = with_extension(tmp_path / "b.nii.gz", 16, room=56, vox_offset=-400.0)
    refused(below, "cannot be parsed|first voxel at byte -400")


@pytest.mark.parametrize(("offset", "shown"), [(np.inf, "inf"), (np.nan, "nan"), (2.0**100, r"1\.2676506e\+30")])
def test_a_first_voxel_at_no_byte_is_one_line(offset, shown, tmp_path):
    file = with_extension(tmp_path / "a.nii.gz", 16, room=56, vox_offset=offset)
    refused(file, rf"first voxel at byte {shown}\d* \(vox_offset\); the rule is 0 to 1000000")


def test_remarks_of_nibabel_are_notes_and_not_printed(tmp_path, capfd):
    """A form code that NIfTI has not is set to 0 by nibabel, which prints that it was."""
    data = bytearray(plain(tmp_path / "a.nii").read_bytes())
    data[254:256] = struct.pack("<h", 200)  # sform_code
    (tmp_path / "a.nii").write_bytes(data)
    refused(tmp_path / "a.nii", "label 7 .* is nowhere", parse_labels("liver=7"))
    assert capfd.readouterr() == ("", "")
    notes = " ".join(read_label_image(tmp_path / "a.nii", BOTH).notes)
    assert "the header is unusual: sform_code 200 not valid" in notes


def test_what_decoding_takes_is_refused_by_the_header(tmp_path):
    """4 bytes a voxel and one for its label: 5 GB. Nothing is decoded, so the data are left out."""
    (tmp_path / "a.nrrd").write_bytes(
        b"NRRD0004\ntype: uint32\ndimension: 3\nsizes: 1000 1000 1000\nspacings: 1 1 1\nendian: little\n"
        b"encoding: gzip\n\n" + gzip.compress(bytes(1000))
    )
    refused(tmp_path / "a.nrrd", "voxels of 4 bytes, which take 5 GB to read; at most 1.6 GB of this format")


META = "ObjectType = Image|NDims = 3|BinaryData = True|DimSize = 2 2 2|ElementType = MET_UCHAR|ElementDataFile = LOCAL"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("NDims = 3", "NDims = 65536", "its header's ndims is '65536'; the rule is a whole number from 1 to 10"),
        ("NDims = 3", "NDims = -1", "ndims is '-1'"),
        ("DimSize", "CompressedData = True|CompressedDataSize = 1000000000000|DimSize", "at most the file's 1.. bytes"),
        ("LOCAL", "a%d%s%n.raw 0 1 1", "elementdatafile is 'a%d%s%n.raw 0 1 1'; the rule is LOCAL or the name of one"),
        ("LOCAL", "LIST", "elementdatafile is 'LIST'"),
    ],
)
def test_a_header_that_itk_s_reader_does_not_survive(old, new, words, tmp_path):
    """It ends the process, hangs, takes the memory that is stated, or reads what was there before."""
    assert old in META
    (tmp_path / "a.mha").write_bytes(META.replace(old, new).replace("|", "\n").encode() + b"\n" + bytes(8))
    refused(tmp_path / "a.mha", words)


def test_what_a_reader_in_c_prints_is_in_the_error(tmp_path, capfd):
    (tmp_path / "a.mha").write_bytes(META.replace("|", "\n").encode() + b"\n" + bytes(5))
    refused(tmp_path / "a.mha", "data not read completely ideal = 8 : actual = 5")
    assert capfd.readouterr() == ("", "")


@pytest.mark.filterwarnings("error")
def test_numbers_without_end_are_refused_without_a_warning(tmp_path):
    affine, shape = affine_of((4.0, 4.0, 4.0))
    data = bytearray(plain(tmp_path / "a.nii").read_bytes())
    data[280:284] = struct.pack("<f", -np.inf)  # srow_x[0]
    (tmp_path / "a.nii").write_bytes(data)
    refused(tmp_path / "a.nii", "affine has numbers that are not finite")
    spacing = "ElementSpacing = 1e308 1 1|TransformMatrix = 1e9 0 0 0 1 0 0 0 1|DimSize"
    (tmp_path / "a.mha").write_bytes(META.replace("DimSize", spacing).replace("|", "\n").encode() + b"\n" + bytes(8))
    refused(tmp_path / "a.mha", "affine has numbers that are not finite")
    nibabel.save(nibabel.Nifti2Image(labels_on(affine, shape), affine), tmp_path / "second.nii")
    data = bytearray((tmp_path / "second.nii").read_bytes())
    data[480:488] = struct.pack("<d", 1e308)  # srow_z[2]
    (tmp_path / "second.nii").write_bytes(data)
    refused(tmp_path / "second.nii", "voxels are .* x inf mm")
    labels = labels_on(affine, shape).astype(np.float32)
    labels[0, 0, 0] = np.inf
    refused(write_nifti(tmp_path / "b.nii", labels, affine), "holds inf, which is no whole number")
    labels.view(np.uint32)[0, 0, 0] = 0x7F800001  # a NaN of the kind that numpy warns of
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refused(write_nifti(tmp_path / "n.nii", labels, affine), "holds nan, which is no whole number")
    labels[0, 0, 0] = 1e30
    file = write_nifti(tmp_path / "c.nii", labels, affine)
    refused(file, r"there are labels 1, 2, 1000000015\d+", parse_labels("liver=5"))


@pytest.mark.parametrize("slope", [1.0, 2.0])
@pytest.mark.parametrize("kind", [[("R", "u1"), ("G", "u1"), ("B", "u1")], np.complex64])
def test_colours_and_complex_numbers_are_no_labels(kind, slope, tmp_path):
    image = nibabel.Nifti1Image(np.zeros((9, 9, 9), dtype=kind), np.eye(4))
    nibabel.save(image, tmp_path / "a.nii")
    data = bytearray((tmp_path / "a.nii").read_bytes())
    data[112:120] = struct.pack("<ff", slope, 0.0)
    (tmp_path / "a.nii").write_bytes(data)
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
        ("liver=9999999999", "labels are from 1 to"),
        (",".join(f"a{n}={n}" for n in range(1, 40)), "at most 32"),
    ],
)
def test_labels_that_make_no_sense(text, words):
    with pytest.raises(MeshError, match=words):
        parse_labels(text)


def test_labels_are_read_in_order():
    assert [(one.name, one.value) for one in parse_labels("left kidney = 7 ,lesion=2")] == [
        ("left kidney", 7),
        ("lesion", 2),
    ]
