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
    ],
)
def test_a_wrong_file_is_refused(tmp_path, text, named):
    path = tmp_path / "bad.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=named):
        read_recording(path)
