"""Recordings are read as they stand; a wrong file is refused in one line that names the fault."""

import numpy as np
import pytest

from surgsim_apps.identify.recordings import read_recording
from tests.identify.made import HEADER, recording, write_csv


def test_columns_in_any_order_in_si(tmp_path):
    path = tmp_path / "set.csv"
    path.write_text("normal_force_n,note,site,depth_mm\n0.1,a,4,0.5\n0.2,b,4,1.0\n\n0.3,c,2,0.7\n", encoding="utf-8")
    read = read_recording(path)
    assert read.name == "set" and not read.has_places and read.presses[0].time is None
    assert [press.site for press in read.presses] == [4, 2]
    np.testing.assert_allclose(read.presses[0].depth, [0.5e-3, 1.0e-3])
    np.testing.assert_allclose(read.presses[0].force, [0.1, 0.2])


def test_what_is_written_is_read(tmp_path):
    made = recording(lambda depth: depth**1.5, time=np.linspace(0.1, 2.0, 20), samples=10)
    read = read_recording(write_csv(made, tmp_path / "made.csv"))
    assert read.has_places and read.presses[0].time is not None and len(read.presses) == len(made.presses)
    for press, other in zip(read.presses, made.presses):
        np.testing.assert_allclose(press.depth, other.depth, atol=1e-8)
        np.testing.assert_allclose(press.force, other.force, atol=1e-8)
        np.testing.assert_allclose(press.place, other.place, atol=1e-9)
        np.testing.assert_allclose(press.time, other.time, atol=1e-5)
        # At full depth from the tenth sample on: what follows is held.
        assert press.loading == slice(0, 10)


@pytest.mark.parametrize("separator", [";", "\t"])
@pytest.mark.parametrize("mark", [",", "."])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("end", ["\r\n", "\r"])
def test_tables_of_office_programs_are_read(tmp_path, separator, mark, encoding, end):
    """Other columns may have both commas and points."""
    path = tmp_path / "set.csv"
    lines = ["note,site,depth_mm,normal_force_n", "µ. 1%,4,0%5,0%125", "%,4,1,1%5e-1"]
    text = end.join(lines).replace(",", separator).replace("%", mark)
    path.write_bytes(f"{text}{end}".encode(encoding))
    (press,) = read_recording(path).presses
    np.testing.assert_allclose(press.depth, [0.5e-3, 1.0e-3])
    np.testing.assert_allclose(press.force, [0.125, 0.15])


@pytest.mark.parametrize(("encoding", "named"), [("latin-1", "0xb5"), ("utf-16-le", "UTF-8"), ("utf-16-be", "UTF-8")])
@pytest.mark.parametrize("name", ["µ", "note"])
def test_another_encoding_is_named(tmp_path, encoding, named, name):
    (tmp_path / "set.csv").write_bytes(f"site,depth_mm,normal_force_n,{name}\n0,1,1,1\n".encode(encoding))
    if (encoding, name) == ("latin-1", "note"):
        assert len(read_recording(tmp_path / "set.csv").presses) == 1
        return
    with pytest.raises(ValueError, match=named):
        read_recording(tmp_path / "set.csv")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("site,depth_mm\n", "'normal_force_n'"),
        (f"{HEADER}\n", "samples"),
        ("site,depth_mm,normal_force_n,x_mm\n0,1,1,1\n", "y_mm"),
        ("site,depth_mm,normal_force_n\n0,1,much\n", "line 2: .*'much'"),
        ("site,depth_mm,normal_force_n\n0.5,1,1\n", "0.5"),
        ("site,depth_mm,normal_force_n\n0,3000,1\n", "'3000'"),
        ("site,depth_mm,normal_force_n,time_s\n0,1,1,2\n0,2,2,1\n", "site 0: time_s is 1"),
        ("site,depth_mm,normal_force_n,time_s\n0,1,1,1e300\n", "'1e300'"),
        ("site,depth_mm,normal_force_n,x_mm,y_mm,z_mm\n0,1,1,0,0,-1e300\n", "'-1e300'"),
        # Commas between thousands are no decimal commas.
        ("site;depth_mm;normal_force_n;time_s\n0;0.5;0.1;999\n0;1;0.2;1,000\n", "decimal points and commas"),
        ("site;depth_mm;normal_force_n\n0;1.000,5;1\n", "decimal points and commas"),
        ("site,depth_mm,normal_force_n\n0,0,5,0,1\n", "line 2: 5 cells for 3 columns"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path, text, named):
    path = tmp_path / "bad.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=named):
        read_recording(path)
