"""Files that stand in for others, as in a clone without Git LFS, are refused by every reader."""

import shutil
from functools import partial

import pytest

from msdm_core.mesh_files import read_mesh, read_surface
from surgsim_apps.identify.recordings import read_recording
from surgsim_apps.patient.label_readers import read_labels
from surgsim_apps.scoring.results import load_result
from surgsim_env.instruments.arm.model import read_xml
from surgsim_env.palpation.chart import _shipped
from surgsim_env.scene.load import agents_folder, load_scene
from surgsim_env.scripting.motion_file import read_motion

LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:" + "0" * 64 + "\nsize 194\n"
READERS = {
    **dict.fromkeys((".vtu", ".vtk", ".msh", ".mesh"), partial(read_mesh, length_unit="mm")),
    **dict.fromkeys((".stl", ".obj", ".ply"), partial(read_surface, length_unit="mm")),
    **dict.fromkeys((".nii", ".nii.gz", ".nrrd", ".mha", ".dcm"), read_labels),
    ".toml": load_scene,
    ".urdf": read_xml,
    ".csv": read_recording,
    "_hand.csv": read_motion,
    ".npz": partial(_shipped, digest=""),
    ".json": load_result,
}


@pytest.mark.parametrize("ending", READERS)
@pytest.mark.parametrize(
    ("text", "content"),
    [
        (LFS, "git lfs pull"),
        ("<!DOCTYPE html>\n<html>", "web page"),
        (" \n<html>", "web page"),
        ("/annex/objects/MD5E-s1--0.stl\n", "annex get"),
    ],
)
def test_a_stand_in_is_named(tmp_path, ending, text, content):
    file = tmp_path / f"a{ending}"
    file.write_text(text)
    with pytest.raises(ValueError, match=content) as refusal:
        READERS[ending](file)
    assert str(refusal.value).startswith(f"{file} is a ")


@pytest.mark.parametrize("ending", [".json", ".safetensors"])
def test_a_policys_stand_in_is_named(tmp_path, ending):
    pytest.importorskip("torch", reason="needs the `agents` extra")
    from surgsim_apps.training.policy_files import load_policy

    shutil.copy(agents_folder() / "policies" / "retract_dagger.json", tmp_path / "a.json")
    (tmp_path / f"a{ending}").write_text(LFS)
    with pytest.raises(ValueError, match="git lfs pull"):
        load_policy(tmp_path / "a.safetensors")
