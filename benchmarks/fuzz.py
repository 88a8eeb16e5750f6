"""Mutated inputs of every kind that the project reads: each must be valid, or be refused by one line.

    python benchmarks/fuzz.py --seconds 60
    python benchmarks/fuzz.py --inputs 10000 --seed 3 --only meshes,arms
    python benchmarks/fuzz.py --replay arms:17

Valid inputs are made from what is shipped; one to three mutations of their structure (a number becomes NaN, infinite,
negative, huge or 0; keys are dropped, added, of another type; elements doubled) or of their bytes (flipped, cut,
doubled) make each input. A finding is anything but a valid result or a refusal: another exception, an error of a
library's own, a message of several lines, output or a warning of a library, a process that ended, more than 2 GB, more
than 60 s. Inputs are read in worker processes, so that a crash is a finding too. Prints a table; 1 with findings.
"""

import argparse
import contextlib
import gzip
import importlib.util
import io
import json
import math
import multiprocessing
import os
import re
import struct
import sys
import tempfile
import threading
import time
import tomllib
import traceback
import warnings
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.random import Generator

REPOSITORY = Path(__file__).resolve().parents[1]
MEMORY_MOST = 2e9  # [bytes] of a worker with what it reads
SECONDS_MOST = 60.0  # for one input
START_SECONDS = 1800.0  # for a worker's start, which may compile
MESSAGE_LONGEST = 1500  # [characters]
# Odd numbers, as text.
ODD = (
    *("nan", "inf", "-inf", "0", "-1", "1", "2", "1e308", "-1e308", "1e-320", "1e9", "-1e9", "1e5", "65536"),
    *("2147483647", "2147483648", "-2147483648", "4294967295", "9223372036854775807", "18446744073709551616"),
    "0.5",
)


class Case(NamedTuple):
    """A valid input: its files by name, of which the first is read."""

    files: dict[str, bytes]


@dataclass(frozen=True)
class Kind:
    """Inputs of one kind: how valid ones are made, what reads them, and a module without which it is skipped."""

    name: str
    cases: Callable[[Path], Iterator[Case]]
    read: Callable[[Path], None]
    needs: str = ""


# ---- valid inputs and what reads them ---------------------------------------------------------------------------


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def quiet() -> Any:
    from rich.console import Console

    return Console(file=io.StringIO())


def mesh_cases(folder: Path) -> Iterator[Case]:
    import trimesh

    from msdm_core.mesh.tet_mesh import TetMesh
    from msdm_core.mesh_files.mesh_io import write_mesh
    from msdm_core.meshing.lattice_meshing import box_mesh

    block = box_mesh((0.04, 0.03, 0.02), (4, 3, 2))
    region = (block.points[block.tets].mean(axis=1)[:, 0] > 0.02).astype(np.int32)
    mesh = TetMesh(block.points, block.tets, region, {0: "liver", 1: "lesion"})
    for name, file_format in (
        ("a.vtu", None), ("a.vtk", None), ("a.msh", "gmsh"), ("b.msh", "gmsh22"), ("a.mesh", None)
    ):  # fmt: skip
        write_mesh(folder / name, mesh, file_format=file_format)
        yield Case({name: (folder / name).read_bytes()})
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    for name in ("a.stl", "a.ply", "a.obj"):
        ball.export(folder / name)
        yield Case({name: (folder / name).read_bytes()})
    for name, options in (("b.stl", {"file_type": "stl_ascii"}), ("b.ply", {"encoding": "ascii"})):
        ball.export(folder / name, **options)
        yield Case({name: (folder / name).read_bytes()})


def cells_of(size: float) -> Any:
    """Cells of one size [m]."""
    from surgsim_env.patient.meshers import Cells

    return Cells(size, is_given=True, coarsening=1, fine_depth=0.0, approach=(0.0, 0.0, -1.0), face_angle_deg=60.0)


def read_mesh_file(path: Path) -> None:
    from msdm_core.mesh_files.surface_io import SURFACE_SUFFIXES
    from surgsim_env.patient.meshers import mesh_surfaces, read_surfaces
    from surgsim_env.patient.tet_files import read_tets

    if path.suffix in SURFACE_SUFFIXES:
        mesh_surfaces(read_surfaces([path], (), "m", mend=False), cells=cells_of(0.01), mesher="lattice")
    else:
        read_tets(path, None, ())


def scene_cases(folder: Path) -> Iterator[Case]:
    import trimesh

    from msdm_core.mesh_files.mesh_io import write_mesh
    from msdm_core.meshing.lattice_meshing import box_mesh
    from surgsim_env.scene.load import scenes_folder

    organs = scenes_folder() / "organs"
    for name in ("phantom_small", "phantom", "lobe", "agarose_prism", "bovine_liver_block"):
        yield Case({f"{name}.toml": (organs / f"{name}.toml").read_bytes()})
    phantom = (organs / "phantom_small.toml").read_text()
    table = tomllib.loads(phantom)
    size, cells = table["mesh"]["block"]["size"], table["mesh"]["block"]["cells"]
    write_mesh(folder / "organ.vtu", box_mesh(size, cells))
    tets = {"tets": {"file": "organ.vtu", "length_unit": "m"}}
    yield Case({"tets.toml": toml_text({**table, "mesh": tets}), "organ.vtu": (folder / "organ.vtu").read_bytes()})
    box = trimesh.creation.box(bounds=[[-0.5 * size[0], -0.5 * size[1], -size[2]], [0.5 * size[0], 0.5 * size[1], 0.0]])
    box.apply_translation(-box.bounds[0] + box_mesh(size, cells).points.min(axis=0))
    box.export(folder / "organ.stl")
    surface = {"surface": {"file": "organ.stl", "length_unit": "m", "cell_size": 0.005}}
    finer = {**table["timing"], "substep_count": 6}
    yield Case(
        {
            "face.toml": toml_text({**table, "mesh": surface, "timing": finer}),
            "organ.stl": (folder / "organ.stl").read_bytes(),
        }
    )


def read_scene(path: Path) -> None:
    from surgsim_env.coupling.simulation import Simulation
    from surgsim_env.instruments.arm.arm_instrument import parked_place
    from surgsim_env.scene.anatomy import load_anatomy
    from surgsim_env.scene.load import make_scene

    anatomy = load_anatomy(make_scene(path))
    simulation = Simulation(anatomy)
    organ = anatomy.organ(anatomy.demonstration_lesions())
    place = simulation.instrument.parked if hasattr(simulation.instrument, "parked") else parked_place(anatomy)
    simulation.reset(organ, place)
    simulation.control_step(2)


def image_cases(folder: Path) -> Iterator[Case]:
    import nibabel
    import SimpleITK

    grid = np.stack(np.meshgrid(*map(np.arange, (20, 18, 16)), indexing="ij"), axis=-1)
    organ = (((grid - [9.5, 8.5, 7.5]) / [8.0, 7.0, 6.0]) ** 2).sum(axis=-1) <= 1.0
    lesion = ((grid - [12.0, 8.0, 8.0]) ** 2).sum(axis=-1) <= 6.0
    labels = np.where(lesion, 2, organ).astype(np.uint8)
    image = nibabel.Nifti1Image(labels, np.diag([-4.0, -4.0, 4.0, 1.0]))
    image.header.set_xyzt_units("mm")
    second = nibabel.Nifti2Image(labels.astype(np.int16), np.diag([4.0, 4.0, 4.0, 1.0]))
    for one, name in ((image, "a.nii"), (second, "b.nii")):
        nibabel.save(one, folder / name)
        data = (folder / name).read_bytes()
        yield Case({name: data})
        yield Case({f"{name}.gz": gzip.compress(data, mtime=0)})
    whole = SimpleITK.GetImageFromArray(labels.T)
    whole.SetSpacing((4.0, 4.0, 4.0))
    for name, packed, kind in (
        ("a.nrrd", False, SimpleITK.sitkUInt8), ("b.nrrd", True, SimpleITK.sitkUInt32),
        ("a.mha", False, SimpleITK.sitkFloat32), ("b.mha", True, SimpleITK.sitkInt16),
        ("a.dcm", False, SimpleITK.sitkUInt16),
    ):  # fmt: skip
        SimpleITK.WriteImage(SimpleITK.Cast(whole, kind), str(folder / name), packed)
        yield Case({name: (folder / name).read_bytes()})
    write_segmentation(folder / "b.dcm", labels)
    yield Case({"b.dcm": (folder / "b.dcm").read_bytes()})


def write_segmentation(path: Path, labels: np.ndarray) -> None:
    """A DICOM segmentation of two segments, one frame for each slice of each."""
    import pydicom
    from pydicom.dataset import FileMetaDataset
    from pydicom.pixels.utils import pack_bits
    from pydicom.uid import ExplicitVRLittleEndian

    def item(**values: Any) -> Any:
        data = pydicom.Dataset()
        for name, value in values.items():
            setattr(data, name, value)
        return data

    frames, masks = [], []
    for number in (1, 2):
        for k in range(labels.shape[2]):
            masks.append((labels[..., k] == number).T)
            which, place = item(ReferencedSegmentNumber=number), item(ImagePositionPatient=[0.0, 0.0, 4.0 * k])
            frames.append(item(SegmentIdentificationSequence=[which], PlanePositionSequence=[place]))
    shared = item(
        PlaneOrientationSequence=[item(ImageOrientationPatient=[1, 0, 0, 0, 1, 0])],
        PixelMeasuresSequence=[item(PixelSpacing=[4.0, 4.0], SliceThickness=4.0)],
    )
    kind, segments = "1.2.840.10008.5.1.4.1.1.66.4", [item(SegmentNumber=n, SegmentLabel=f"s{n}") for n in (1, 2)]
    data = item(
        SOPClassUID=kind, SOPInstanceUID="1.2.3", Modality="SEG", SegmentationType="BINARY", SegmentSequence=segments,
        Rows=labels.shape[1], Columns=labels.shape[0], NumberOfFrames=len(frames), SamplesPerPixel=1, BitsAllocated=1,
        BitsStored=1, HighBit=0, PixelRepresentation=0, PhotometricInterpretation="MONOCHROME2",
        SharedFunctionalGroupsSequence=[shared], PerFrameFunctionalGroupsSequence=frames,
    )  # fmt: skip
    data.PixelData = pack_bits(np.stack(masks).ravel().astype(np.uint8))
    meta: Any = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = kind, "1.2.3"
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.file_meta = meta
    pydicom.dcmwrite(path, data, enforce_file_format=True)


def read_image(path: Path) -> None:
    from surgsim_env.patient.label_image import parse_labels, read_label_image
    from surgsim_env.patient.meshers import mesh_image

    # A DICOM image of SimpleITK's has its labels as numbers of voxels, like the others.
    image = read_label_image(path, parse_labels("liver=1,lesion=2"))
    mesh_image(image, path.name, cells=cells_of(0.012), mesher="lattice", mend=True)


STICK = """<robot name="stick">
  <link name="base">
    <collision name="foot"><geometry><cylinder radius="0.03" length="0.1"/></geometry></collision></link>
  <link name="swing">
    <inertial><mass value="0.5"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://stick/swing.stl"/></geometry></visual>
  </link>
  <link name="stick">
    <inertial><origin xyz="0 0 -0.1"/><mass value="0.2"/>
      <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision name="ball"><origin xyz="0 0 -0.2"/><geometry><sphere radius="0.006"/></geometry></collision>
  </link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="swing"/><axis xyz="1 0 0"/>
    <limit lower="-0.8" upper="0.8" effort="10" velocity="2"/></joint>
  <joint name="slide" type="prismatic"><parent link="swing"/><child link="stick"/><axis xyz="0 0 -1"/>
    <limit lower="0" upper="0.2" effort="20" velocity="0.3"/></joint>
</robot>
"""
STICK_TABLE = {
    "model": "stick.urdf", "kind": "palpator", "joints": ["turn", "slide"], "contact": ["ball"],
    "tip": {"body": "stick", "offset": [0.0, 0.0, -0.2], "direction": [0.0, 0.0, -1.0], "ball": "ball"},
    "trocar": {"shaft_body": "stick", "shaft_axis": [0.0, 0.0, -1.0], "fixed": True},
    "control": {
        "mode": "servo", "speed_limit": [1.0, 0.2], "stiffness": [200.0, 2000.0], "damping": [10.0, 60.0],
        "effort": [10.0, 20.0],
    },
    "home": {"turn": 0.1, "slide": 0.05},
}  # fmt: skip
# What a model may ask much with, for mutations of XML.
COSTLY = (
    '<replicate count="{0}" offset="0.1 0 0"><geom size="0.01"/></replicate>',
    '<body><joint/><geom size="{0}"/></body>',
    '<flexcomp name="soft" type="grid" count="{0} 3 3" spacing="0.1 0.1 0.1"/>', '<include file="{0}"/>',
    '<geom type="mesh" mesh="m{0}"/>', '<body name="yaw"><geom size="0.1"/></body>', '<site name="tip"/>',
    '<frame pos="{0} 0 0"><geom size="0.1"/></frame>', '<camera resolution="{0} {0}"/>',
)  # fmt: skip
COSTLY_ASSETS = (
    '<texture name="t" builtin="flat" type="2d" width="{0}" height="64"/>', '<texture name="t" file="swing.stl"/>',
    '<hfield name="h" nrow="{0}" ncol="4" size="1 1 1 1"/>', '<mesh name="m" builtin="supersphere" params="{0} 1 1"/>',
    '<mesh name="m" file="swing.stl" maxhullvert="{0}"/>', '<mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 {0}"/>',
)  # fmt: skip
COSTLY_PARTS = (
    '<size memory="{0}"/>', '<size nkey="{0}"/>', '<custom><numeric name="n" size="{0}"/></custom>',
    '<compiler><lengthrange mode="all" inttotal="{0}"/></compiler>', '<option timestep="{0}"/>',
    '<keyframe><key qpos="{0}"/></keyframe>', '<sensor><user dim="{0}"/></sensor>', '<statistic extent="{0}"/>',
)  # fmt: skip


def arm_cases(folder: Path) -> Iterator[Case]:
    import trimesh

    from surgsim_env.scene.load import scenes_folder

    instruments = scenes_folder() / "instruments"
    for name in ("psm_palpator", "psm_grasper", "psm_retractor", "six_axis"):
        yield Case({f"{name}{end}": (instruments / f"{name}{end}").read_bytes() for end in (".toml", ".xml")})
    trimesh.creation.icosphere(subdivisions=2, radius=0.03).export(folder / "swing.stl")
    mesh = (folder / "swing.stl").read_bytes()
    yield Case({"stick.toml": toml_text(STICK_TABLE), "stick.urdf": STICK.encode(), "swing.stl": mesh})


def read_arm(path: Path) -> None:
    from surgsim_env.instruments.arm.arm import load_arm

    arm = load_arm(path)
    arm.tip_pose(arm.home)


ENVIRONMENTS = (("SurgSim/Palpate-v0", "phantom_small"), ("SurgSim/PalpateSites-v0", "phantom_small"))
_environments: dict[str, Any] = {}


def environment(number: int) -> Any:
    import gymnasium as gym

    import surgsim_env  # noqa: F401  # registers the ids

    env_id, scene = ENVIRONMENTS[number]
    if env_id not in _environments:
        _environments[env_id] = gym.make(env_id, scene=scene, disable_env_checker=True)
        _environments[env_id].reset(seed=1)
    return _environments[env_id]


def state_cases(folder: Path) -> Iterator[Case]:
    for number in range(len(ENVIRONMENTS)):
        env = environment(number)
        env.reset(seed=number)
        env.action_space.seed(0)
        env.step(env.action_space.sample())
        yield Case({f"state{number}.npz": env.unwrapped.save_state()})


def read_state(path: Path) -> None:
    import gymnasium as gym

    env = environment(int(path.stem.removeprefix("state")))
    env.reset(seed=0)
    env.unwrapped.load_state(path.read_bytes())
    env.action_space.seed(0)
    try:
        observation, *_ = env.step(env.action_space.sample())
    except gym.error.ResetNeeded:
        # A state of an episode that is over.
        return
    if not np.isfinite(observation).all():
        raise AssertionError("an observation is not finite after a state was loaded")


def csv_cases(folder: Path) -> Iterator[Case]:
    from surgsim_env.haptics.trajectory import save_trajectory

    times = np.linspace(0.0, 0.3, 31)
    places = np.stack([0.01 * np.sin(times), 0.01 * np.cos(times), -0.001 * times], axis=1)
    save_trajectory(folder / "one.csv", times, places, [0, 1] * 15 + [0])
    yield Case({"one.csv": (folder / "one.csv").read_bytes()})
    rows = ["time,x,y,z,buttons,x_2,y_2,z_2,note", *(f"{t},{t},0,0,1,0,{t},0,hand" for t in times)]
    yield Case({"two.csv": "\n".join(rows).encode()})


def read_csv(path: Path) -> None:
    from surgsim_env.haptics.trajectory import TrajectoryDevice, read_motion

    if path.stem == "two":
        read_motion(path, ["", "_2"], rows_largest=1000)
    device = TrajectoryDevice.load(path)
    for _ in range(3):
        device.read()
        assert device.over in (True, False)


def policy_cases(folder: Path) -> Iterator[Case]:
    policies = REPOSITORY / "agents" / "policies"
    # The smallest of each shape, as a mutation needs a copy of all weights.
    for path in sorted(policies.glob("*.safetensors"), key=lambda path: path.stat().st_size)[:4]:
        yield Case({path.name: path.read_bytes(), f"{path.stem}.json": path.with_suffix(".json").read_bytes()})


def read_policy(path: Path) -> None:
    from surgsim_env.training.policy_files import load_policy
    from surgsim_env.training.policy_network import PolicyNetwork

    policy = load_policy(path)
    policy.reset(2)
    if isinstance(policy.decider, PolicyNetwork) and policy.decider.layout.features is None:
        policy.act(np.full((2, policy.decider.layers[0].in_features), 0.5, dtype=np.float32))


KINDS = {
    kind.name: kind
    for kind in (
        Kind("meshes", mesh_cases, read_mesh_file),
        Kind("scenes", scene_cases, read_scene),
        Kind("images", image_cases, read_image, needs="nibabel"),
        Kind("arms", arm_cases, read_arm),
        Kind("states", state_cases, read_state),
        Kind("csv", csv_cases, read_csv),
        Kind("policies", policy_cases, read_policy, needs="safetensors"),
    )
}

# ---- mutations --------------------------------------------------------------------------------------------------


def pick(rng: Generator, things: Any) -> Any:
    return things[int(rng.integers(len(things)))]


def odd_value(rng: Generator) -> Any:
    """A value of any type that a table can hold."""
    made = (
        lambda: float(pick(rng, ODD)), lambda: int(float(pick(rng, ("0", "-1", "7", "1e9", "1e18")))), lambda: True,
        lambda: "", lambda: "x" * 300, lambda: "../../etc/passwd", lambda: "ä\u2028\x00", lambda: [], lambda: {},
        lambda: [1.0, 2.0], lambda: ["a", 1], lambda: {"a": {"b": [1]}}, lambda: [[0.0] * 3] * 2, lambda: "nan",
    )  # fmt: skip
    return pick(rng, made)()


def mutate_tree(root: Any, rng: Generator) -> tuple[Any, str]:
    """A table or list with one entry dropped, added, doubled, or of another value or type."""
    places: list[tuple[Any, Any]] = []

    def visit(part: Any) -> None:
        keys = part.keys() if isinstance(part, dict) else range(len(part)) if isinstance(part, list) else ()
        for key in keys:
            places.append((part, key))
            visit(part[key])

    visit(root)
    if not places:
        return odd_value(rng), "replaced by an odd value"
    part, key = pick(rng, places)
    old = part[key]
    kind = pick(rng, ("number", "number", "number", "odd", "drop", "add", "double", "swap", "scale"))
    if kind == "drop":
        del part[key]
    elif kind == "add":
        if isinstance(part, dict):
            part[pick(rng, ("x", "name", "file", "radius", str(key) + "s", ""))] = odd_value(rng)
        else:
            part.insert(key, odd_value(rng))
    elif kind == "double" and isinstance(part, list):
        part[key:key] = [old] * int(pick(rng, (1, 2, 1000)))
    elif kind == "swap":
        other, second = pick(rng, places)
        part[key] = json.loads(json.dumps(other[second], default=str))
    elif kind == "scale" and isinstance(old, int | float) and not isinstance(old, bool):
        part[key] = type(old)(old * pick(rng, (-1, 0.01, 0.5, 2, 100, 10000)))
    elif kind in ("number", "scale") and isinstance(old, int | float | list):
        value = float(pick(rng, ODD))
        whole = isinstance(old, int) and math.isfinite(value) and rng.random() < 0.8
        part[key] = int(value) if whole else value
    else:
        part[key] = odd_value(rng)
    shown = repr(part[key]) if kind not in ("drop", "add") and not isinstance(part, list) else ""
    return root, f"{kind} at {key!r} {shown[:60]}"


def toml_text(table: dict[str, Any]) -> bytes:
    import tomlkit

    return tomlkit.dumps(table).encode()


def mutate_toml(data: bytes, rng: Generator) -> tuple[bytes, str]:
    table, what = mutate_tree(tomllib.loads(data.decode()), rng)
    return toml_text(table if isinstance(table, dict) else {"a": table}), what


def mutate_json(data: bytes, rng: Generator) -> tuple[bytes, str]:
    table, what = mutate_tree(json.loads(data), rng)
    return json.dumps(table).encode(), what


def mutate_text(data: bytes, rng: Generator) -> tuple[bytes, str]:
    """Lines dropped, doubled or swapped, or a number replaced by an odd one."""
    text = data.decode("latin-1")
    kind = pick(rng, ("number", "number", "number", "number", "drop line", "double line", "swap lines", "word"))
    if kind in ("number", "word"):
        pattern = r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w])" if kind == "number" else r"[A-Za-z_]{3,}"
        found = list(re.finditer(pattern, text[:200_000]))
        if not found:
            return mutate_bytes(data, rng)
        one = pick(rng, found)
        new = pick(rng, ODD) if kind == "number" else pick(rng, [match.group() for match in found])
        return f"{text[: one.start()]}{new}{text[one.end() :]}".encode("latin-1"), f"{one.group()!r} becomes {new!r}"
    lines = text.splitlines(keepends=True)
    first, second = sorted(int(rng.integers(len(lines))) for _ in range(2))
    if kind == "drop line":
        del lines[first]
    elif kind == "double line":
        lines[first:first] = [lines[first]] * int(pick(rng, (1, 3, 500)))
    else:
        lines[first], lines[second] = lines[second], lines[first]
    return "".join(lines).encode("latin-1"), f"{kind} {first}"


def mutate_bytes(data: bytes, rng: Generator) -> tuple[bytes, str]:
    """Bytes flipped, cut off, dropped, doubled or overwritten by an odd number."""
    if not data:
        return b"\x00", "a byte added"
    new, size = bytearray(data), len(data)
    kind = pick(rng, ("flip", "flip", "cut", "drop", "double", "number", "number", "zero"))
    # Half of the places are within the first kilobyte, where headers are.
    first = int(rng.integers(min(size, 1024) if rng.random() < 0.5 else size))
    length = int(rng.integers(1, 64))
    if kind == "flip":
        for _ in range(int(rng.integers(1, 6))):
            place = min(first + int(rng.integers(64)), size - 1)
            new[place] ^= 1 << int(rng.integers(8))
    elif kind == "cut":
        del new[first:]
    elif kind == "drop":
        del new[first : first + length]
    elif kind == "double":
        new[first:first] = new[first : first + length]
    elif kind == "zero":
        new[first : first + length] = bytes(len(new[first : first + length]))
    else:
        value = float(pick(rng, ODD))
        form = pick(rng, ("<f", "<d", "<i", "<q", "<h", ">i", ">d"))
        if form[1] in "iqh":
            most = 2 ** (8 * struct.calcsize(form) - 1)
            value = int(min(max(value, -most), most - 1)) if math.isfinite(value) else -1
        elif form == "<f":
            value = float(np.clip(value, -3e38, 3e38))
        first -= first % struct.calcsize(form)
        number = struct.pack(form, value)
        new[first : first + len(number)] = number
    return bytes(new), f"{kind} at byte {first} of {size}"


def mutate_xml(data: bytes, rng: Generator) -> tuple[bytes, str]:
    """An element dropped, doubled, moved, renamed or added, or an attribute changed."""
    root = ElementTree.fromstring(data)
    elements = list(root.iter())
    parents = {child: parent for parent in elements for child in parent}
    kind = pick(
        rng, ("number", "number", "number", "attribute", "drop", "double", "move", "rename", "costly", "costly")
    )
    one = pick(rng, elements)
    what = f"{kind} <{one.tag}>"
    number = pick(rng, ODD)
    if kind == "costly" and root.tag == "mujoco":
        where, texts = pick(rng, ((root.find("worldbody"), COSTLY), (None, COSTLY_ASSETS), (root, COSTLY_PARTS)))
        where = where if where is not None else ElementTree.SubElement(root, "asset")
        text = pick(rng, texts).format(number)
        where.insert(0, ElementTree.fromstring(text))
        what = f"added {text}"
    elif kind in ("number", "costly") and any(part.attrib for part in elements):
        one = pick(rng, [part for part in elements if part.attrib])
        name = pick(rng, list(one.attrib))
        words = one.attrib[name].split() or [""]
        words[int(rng.integers(len(words)))] = number
        one.attrib[name] = " ".join(words)
        what = f"<{one.tag} {name}={one.attrib[name]!r}>"
    elif kind == "attribute":
        other = pick(rng, [part for part in elements if part.attrib] or [one])
        if one.attrib and rng.random() < 0.5:
            del one.attrib[pick(rng, list(one.attrib))]
        elif other.attrib:
            name = pick(rng, list(other.attrib))
            one.set(name, other.attrib[name])
    elif one is not root and kind == "drop":
        parents[one].remove(one)
    elif one is not root and kind == "double":
        for _ in range(int(pick(rng, (1, 2, 300)))):
            parents[one].append(one)
    elif one is not root and kind == "move":
        target = pick(rng, [part for part in elements if part not in set(one.iter())] or [root])
        parents[one].remove(one)
        target.append(one)
    else:
        one.tag = pick(rng, elements).tag
    return ElementTree.tostring(root), what


def mutate_csv(data: bytes, rng: Generator) -> tuple[bytes, str]:
    rows = [line.split(",") for line in data.decode().splitlines()]
    row, column = int(rng.integers(len(rows))), int(rng.integers(len(rows[0])))
    kind = pick(rng, ("cell", "cell", "cell", "column", "quote", "row", "header"))
    if kind == "column":
        rows = [line[:column] + line[column + 1 :] for line in rows]
    elif kind == "row":
        rows[row:row] = [rows[row]] * int(pick(rng, (1, 100, 5000)))
    elif kind == "header":
        rows[0][column] = pick(rng, (*rows[0], "", "X", "\ufeff", "é"))
    else:
        row = min(row, len(rows) - 1)
        rows[row][min(column, len(rows[row]) - 1)] = (
            '"' if kind == "quote" else pick(rng, (*ODD, "", "a", "1;2", "\x00"))
        )
    return "\n".join(map(",".join, rows)).encode(), f"{kind} {column} of row {row}"


def mutate_nifti(data: bytes, rng: Generator) -> tuple[bytes, str]:
    """A field of the header with an odd value."""
    from nibabel.nifti1 import Nifti1Header
    from nibabel.nifti2 import Nifti2Header

    dtype: Any = (Nifti1Header if data[344:347] == b"n+1" else Nifti2Header).template_dtype
    header = np.frombuffer(bytearray(data[: dtype.itemsize]), dtype=dtype).copy()
    name = pick(rng, [name for name in dtype.names or () if dtype[name].base.kind in "iuf"])
    place, value = header[name].reshape(-1), float(pick(rng, ODD))
    entry = int(rng.integers(place.size))
    if place.dtype.kind == "f":
        with np.errstate(over="ignore"):
            place[entry] = value
    else:
        info = np.iinfo(str(place.dtype))
        place[entry] = int(min(max(value, info.min), info.max)) if math.isfinite(value) else info.max
    header[name] = place.reshape(header[name].shape)
    return header.tobytes() + data[dtype.itemsize :], f"{name}[{entry}] = {place[entry]}"


def mutate_header(data: bytes, rng: Generator) -> tuple[bytes, str]:
    """The text header of an NRRD or MetaImage file."""
    end = data.find(b"\n\n") if data.startswith(b"NRRD") else data.find(b"\n", data.find(b"ElementDataFile"))
    head, what = mutate_text(data[: end + 1], rng)
    return head + data[end + 1 :], what


def mutate_dicom(data: bytes, rng: Generator) -> tuple[bytes, str]:
    """An element of the data set dropped or with an odd value."""
    import pydicom

    read = pydicom.dcmread(io.BytesIO(data))
    places = [(read, one.tag) for one in read] + [(read.file_meta, one.tag) for one in read.file_meta]
    for sequence in [one for one in read if one.VR == "SQ"]:
        for item in list(sequence.value)[:3]:
            places += [(item, one.tag) for one in item]
            places += [(deep, one.tag) for inner in item if inner.VR == "SQ" for deep in inner.value for one in deep]
    part, tag = pick(rng, places)
    one, kind = part[tag], pick(rng, ("drop", "odd", "odd", "odd"))
    what = f"{kind} {one.keyword}"
    if kind == "drop":
        del part[tag]
    elif one.VR == "SQ":
        one.value = list(one.value)[: int(rng.integers(len(one.value) + 1))] * int(pick(rng, (1, 2)))
    else:
        # Past the checks of a writer.
        text = pick(rng, (*ODD, "", "x", "1\\2\\3", "9" * 20))
        number = int(np.clip(np.nan_to_num(float(pick(rng, ODD)), posinf=1e9, neginf=0.0), 0, 65535))
        value = {"US": number, "UL": number, "OB": b"\x01" * (number % 4000), "OW": b"\x01" * (number % 4000)}
        one._value = value.get(one.VR, text if one.VM <= 1 else [text] * int(pick(rng, (1, one.VM, 5))))
    buffer = io.BytesIO()
    pydicom.dcmwrite(buffer, read, enforce_file_format=False)
    return buffer.getvalue(), what


def mutate_arrays(data: bytes, rng: Generator) -> tuple[bytes, str]:
    """The arrays of a saved state: one of another value, shape or type, dropped, renamed or added."""
    arrays = dict(np.load(io.BytesIO(data), allow_pickle=False))
    name = pick(rng, sorted(arrays))
    array, kind = (
        arrays[name],
        pick(rng, ("value", "value", "value", "type", "shape", "drop", "rename", "add", "table")),
    )
    tables = [key for key, one in arrays.items() if one.dtype.kind == "U" and one.item().startswith("{")]
    if kind == "table" and tables:
        name = pick(rng, tables)
        table, what = mutate_tree(json.loads(arrays[name].item()), rng)
        arrays[name], kind = np.array(json.dumps(table)), f"table {what}"
    elif kind == "value" and array.dtype.kind in "fiub" and array.size:
        new = array.copy().reshape(-1)
        value, entry = float(pick(rng, ODD)), int(rng.integers(new.size))
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            new[entry] = np.array(value).astype(new.dtype) if rng.random() < 0.7 else np.array(entry).astype(new.dtype)
        arrays[name], kind = new.reshape(array.shape), f"value [{entry}] = {new[entry]}"
    elif kind == "type":
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            odd = {"f": "f4", "i": "i8", "U": "S99", "b": "i1", "u": "i8"}.get(array.dtype.kind, "f8")
            arrays[name] = array.astype(pick(rng, (odd, "U30", ">f8" if array.dtype.kind in "fiub" else "U9")))
    elif kind == "shape":
        arrays[name] = pick(
            rng, (array.reshape(-1)[:-1], array[None], np.zeros(0), np.resize(array, (3, 4)), np.array(1))
        )
    elif kind == "drop":
        del arrays[name]
    else:
        arrays[pick(rng, ("extra", "task", f"{name}2", "a/b"))] = arrays.pop(name) if kind == "rename" else array
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue(), f"{name}: {kind}"


def mutate_tensors(data: bytes, rng: Generator) -> tuple[bytes, str]:
    """The table of a safetensors file, which says where weights lie."""
    (length,) = struct.unpack("<Q", data[:8])
    table, what = mutate_tree(json.loads(data[8 : 8 + length]), rng)
    head = json.dumps(table).encode()
    return struct.pack("<Q", len(head)) + head + data[8 + length :], what


def mutate_packed(data: bytes, rng: Generator) -> tuple[bytes, str]:
    inside, what = mutate_nifti(gzip.decompress(data), rng) if rng.random() < 0.8 else mutate_bytes(data, rng)
    return gzip.compress(inside, 1, mtime=0), f"unpacked: {what}"


Mutation = Callable[[bytes, Generator], tuple[bytes, str]]
STRUCTURES: dict[str, Mutation] = {
    ".toml": mutate_toml, ".json": mutate_json, ".xml": mutate_xml, ".urdf": mutate_xml, ".vtu": mutate_text,
    ".csv": mutate_csv, ".nii": mutate_nifti, ".gz": mutate_packed, ".nrrd": mutate_header, ".mha": mutate_header,
    ".dcm": mutate_dicom, ".npz": mutate_arrays, ".safetensors": mutate_tensors, ".vtk": mutate_text,
    ".msh": mutate_text, ".mesh": mutate_text, ".obj": mutate_text, ".ply": mutate_text, ".stl": mutate_text,
}  # fmt: skip
TEXTS = (".toml", ".json", ".xml", ".urdf", ".csv", ".vtu")


def mutated(case: Case, rng: Generator) -> tuple[Case, str]:
    """The files of a case after one to three mutations, and these in words."""
    files, said = dict(case.files), []
    for _ in range(int(pick(rng, (1, 1, 2, 3)))):
        name = pick(rng, list(files))
        suffix = Path(name).suffix
        chance = rng.random()
        mutation = (
            STRUCTURES[suffix] if chance < 0.7 else mutate_text if chance < 0.8 and suffix in TEXTS else mutate_bytes
        )
        try:
            files[name], what = mutation(files[name], rng)
        except Exception:
            # An earlier mutation has left no structure, or a library does not write the odd value.
            files[name], what = mutate_bytes(files[name], rng)
        said.append(f"{name}: {what}")
    for name in [name for name in files if name.endswith(".safetensors")]:
        # Otherwise nothing but the digest would be tried.
        if rng.random() < 0.8:
            files[f"{Path(name).stem}.json"] = with_digest(files[f"{Path(name).stem}.json"], files[name])
    return Case(files), "; ".join(said)


def with_digest(document: bytes, weights: bytes) -> bytes:
    import hashlib

    with contextlib.suppress(ValueError):
        table = json.loads(document)
        if isinstance(table, dict) and "sha256" in table:
            return json.dumps({**table, "sha256": hashlib.sha256(weights).hexdigest()}).encode()
    return document


# ---- workers ----------------------------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """What became of one input: status "valid", "refused" or "finding"."""

    status: str
    said: str
    mutation: str = ""
    seconds: float = 0.0
    memory: float = 0.0  # [bytes]


def refusal_fault(error: BaseException) -> str:
    """What is wrong with an error as a refusal; empty for a right one."""
    text = str(error)
    module = type(error).__module__.partition(".")[0]
    frames = traceback.extract_tb(error.__traceback__)
    ours = bool(frames) and any(Path(frames[-1].filename).is_relative_to(REPOSITORY / name) for name in OURS)
    if isinstance(error, OSError):
        ours = error.filename is not None
    elif type(error) is not ValueError and module not in OURS:
        return f"{type(error).__name__}: {text[:300]}"
    if not ours:
        return f"{type(error).__name__} of a library: {text[:300]}"
    if "\n" in text.strip() or len(text) > MESSAGE_LONGEST or not text:
        return f"message of {len(text.splitlines())} lines and {len(text)} characters: {text[:300]!r}"
    return ""


OURS = ("msdm_core", "surgsim_env", "agents")


def attempt(kind: Kind, case: Case, folder: Path, output: Any) -> tuple[str, str]:
    """Read an input; status and what was said."""
    for name, data in case.files.items():
        (folder / name).write_bytes(data)
    path = folder / next(iter(case.files))
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = show_warning
        try:
            kind.read(path)
            status, said = "valid", ""
        # Whatever comes is judged.
        except Exception as error:
            fault = refusal_fault(error)
            status, said = ("finding", f"{fault}\n{traceback.format_exc()}") if fault else ("refused", str(error))
    printed = output() if output else ""
    if status != "finding" and printed.strip():
        status, said = "finding", f"output {' '.join(printed.split())[:400]!r}; {status} {said[:200]}"
    return status, said


def show_warning(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: object) -> None:
    """Print the warnings of libraries, which are findings; the command line shows those of the project as its own."""
    if not (category is UserWarning and is_ours(filename)):
        print(f"{category.__name__}: {message} ({filename}:{lineno})", file=sys.stderr)


def is_ours(filename: str) -> bool:
    return Path(filename).is_relative_to(REPOSITORY) and "site-packages" not in filename


def made_input(kind: Kind, cases: list[Case], seed: int) -> tuple[Case, str]:
    """The input of a seed: the same on every run."""
    rng = np.random.default_rng([zlib.crc32(kind.name.encode()), seed])
    return mutated(pick(rng, cases), rng)


def work(kinds: list[str], pipe: Connection) -> None:
    """Read inputs whose kind and seed come through a pipe, until it closes."""
    # What libraries print goes into a file; only the pipe speaks.
    written = tempfile.TemporaryFile()
    for stream in (1, 2):
        os.dup2(written.fileno(), stream)

    def output() -> str:
        sys.stdout.flush()
        sys.stderr.flush()
        written.seek(0)
        text = written.read().decode(errors="replace")
        written.seek(0)
        written.truncate()
        return text

    cases: dict[str, list[Case]] = {}
    with tempfile.TemporaryDirectory(prefix="surgsim-fuzz-") as home:
        os.chdir(home)
        for name in kinds:
            (made := Path(home, f"{name}-cases")).mkdir()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                cases[name] = list(KINDS[name].cases(made))
            for case in cases[name]:
                (Path(home) / "valid").mkdir(exist_ok=True)
                status, said = attempt(KINDS[name], case, Path(home) / "valid", None)
                if status != "valid":
                    pipe.send(f"{name}: the unmutated {next(iter(case.files))} is {status}: {said}")
                    return
            output()
        pipe.send("")
        while True:
            try:
                name, seed = pipe.recv()
            except EOFError:
                return
            case, mutation = made_input(KINDS[name], cases[name], seed)
            pipe.send(mutation)
            # What making it printed.
            output()
            with tempfile.TemporaryDirectory(prefix="in-", dir=home) as folder:
                forget_peak()
                begin = time.perf_counter()
                status, said = attempt(KINDS[name], case, Path(folder), output)
                seconds = time.perf_counter() - begin
            pipe.send(Outcome(status, said, mutation, seconds, peak_memory()))


def forget_peak() -> None:
    """Begin to measure the peak of this process's memory anew, on Linux."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> float:
    """The largest memory of this process since `forget_peak` [bytes]; 0 where that is not known."""
    return status_of("self", "VmHWM")


def status_of(process: int | str, name: str) -> float:
    try:
        found = re.search(rf"{name}:\s+(\d+) kB", Path(f"/proc/{process}/status").read_text())
    except OSError:
        return 0.0
    return 1024.0 * float(found.group(1)) if found else 0.0


class Worker:
    """A process that reads inputs, made again after it ended or was ended."""

    def __init__(self, kinds: list[str]) -> None:
        self.kinds = kinds
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=work, args=(self.kinds, theirs), daemon=True)
        self.process.start()
        theirs.close()
        if not self.pipe.poll(START_SECONDS):
            raise SystemExit(f"fuzz: a worker did not start within {START_SECONDS:g} s")
        said = self.pipe.recv() if self.process.is_alive() or self.pipe.poll() else "a worker ended as it started"
        if said:
            raise SystemExit(f"fuzz: {said}")

    def read(self, kind: str, seed: int) -> Outcome:
        """What becomes of an input; a process that ends, takes too long or too much is a finding."""
        mutation, begin, most, fault, sent = "not known", time.perf_counter(), 0.0, "", False
        while not fault:
            try:
                if not sent:
                    self.pipe.send((kind, seed))
                    sent = True
                if self.pipe.poll(0.1):
                    got = self.pipe.recv()
                    if isinstance(got, Outcome):
                        if got.memory > MEMORY_MOST:
                            return got._replace(status="finding", said=f"memory: {got.memory / 1e9:.2f} GB; {got.said}")
                        return got
                    mutation = got
            except (EOFError, ConnectionError):
                self.process.join(10.0)
                fault = f"the process ended with {self.process.exitcode}"
            most = max(most, status_of(self.process.pid or 0, "VmRSS"))
            if most > MEMORY_MOST:
                fault = f"memory: more than {MEMORY_MOST / 1e9:g} GB"
            if time.perf_counter() - begin > SECONDS_MOST:
                fault = f"time: more than {SECONDS_MOST:g} s"
        self.close()
        seconds = time.perf_counter() - begin
        self._start()
        return Outcome("finding", fault, mutation, seconds, most)

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


# ---- the run ----------------------------------------------------------------------------------------------------


@dataclass
class Tally:
    """Results of one kind."""

    counts: Counter = field(default_factory=Counter)
    slowest: float = 0.0
    memory: float = 0.0
    spent: float = 0.0
    begun: int = 0


class Run:
    """Inputs handed to workers until a number or a time is over."""

    def __init__(self, kinds: list[str], seed: int, inputs: int | None, seconds: float | None) -> None:
        self.tallies = {name: Tally() for name in kinds}
        self.findings: dict[str, list[tuple[str, int, Outcome]]] = defaultdict(list)
        self._first, self._inputs, self._lock = seed * 1_000_000, inputs, threading.Lock()
        self._end = None if seconds is None else time.perf_counter() + seconds
        self._shown = time.perf_counter()

    def next_input(self) -> tuple[str, int] | None:
        """Kind and seed of the next input: of the kind with the fewest, or with the least time where time is given."""
        with self._lock:
            if self._end is not None and time.perf_counter() > self._end:
                return None
            if self._inputs is not None and sum(one.begun for one in self.tallies.values()) >= self._inputs:
                return None
            timed = self._end is not None
            name = min(self.tallies, key=lambda one: self.tallies[one].spent if timed else self.tallies[one].begun)
            tally = self.tallies[name]
            tally.begun += 1
            # Another worker takes another kind meanwhile.
            tally.spent += 1e-3
            return name, self._first + tally.begun - 1

    def note(self, name: str, seed: int, outcome: Outcome) -> None:
        """Count an outcome; print a finding at once."""
        with self._lock:
            tally = self.tallies[name]
            tally.counts[outcome.status] += 1
            tally.spent += outcome.seconds
            tally.slowest, tally.memory = max(tally.slowest, outcome.seconds), max(tally.memory, outcome.memory)
            if outcome.status == "finding":
                self.findings[name].append((name, seed, outcome))
                print(f"finding {name}:{seed} [{outcome.mutation}] {outcome.said.splitlines()[0]}", flush=True)
            now = time.perf_counter()
            if now - self._shown > (1.0 if sys.stderr.isatty() else 10.0):
                self._shown = now
                done = sum(sum(one.counts.values()) for one in self.tallies.values())
                found = sum(one.counts["finding"] for one in self.tallies.values())
                print(f"fuzz: {done} inputs, {found} findings", file=sys.stderr, flush=True)

    def serve(self, worker: Worker) -> None:
        """Give a worker inputs until there are no more."""
        while (given := self.next_input()) is not None:
            self.note(*given, worker.read(*given))
        worker.close()

    def table(self) -> str:
        """Counts, slowest input and largest memory of each kind."""
        lines = [
            f"{'kind':<10}{'inputs':>8}{'valid':>8}{'refused':>9}{'findings':>10}{'slowest':>10}{'most memory':>13}"
        ]
        total = Tally()
        for name, one in [*self.tallies.items(), ("all", total)]:
            counts = one.counts
            lines.append(
                f"{name:<10}{sum(counts.values()):>8}{counts['valid']:>8}{counts['refused']:>9}{counts['finding']:>10}"
                f"{one.slowest:>8.1f} s{one.memory / 1e6:>10.0f} MB"
            )
            total.counts += counts
            total.slowest, total.memory = max(total.slowest, one.slowest), max(total.memory, one.memory)
        return "\n".join(lines)


def replay(text: str) -> int:
    """Read one input again in this process and print what was changed and what comes of it."""
    name, _, seed = text.partition(":")
    if name not in KINDS or not seed.isdigit():
        raise SystemExit(f"fuzz: --replay is {text!r}; the form is KIND:SEED with a kind of {', '.join(KINDS)}")
    with tempfile.TemporaryDirectory(prefix="surgsim-fuzz-") as home:
        (Path(home) / "cases").mkdir()
        case, mutation = made_input(KINDS[name], list(KINDS[name].cases(Path(home) / "cases")), int(seed))
        (folder := Path(home) / "input").mkdir()
        print(f"{text}: {mutation}", flush=True)
        status, said = attempt(KINDS[name], case, folder, None)
        print(f"{status}: {said} ({peak_memory() / 1e6:.0f} MB)")
    return int(status == "finding")


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, help="number of inputs; as many of each kind")
    parser.add_argument("--seconds", type=float, help="duration [s]; as long for each kind; 60 without --inputs")
    parser.add_argument("--seed", type=int, default=0, help="another number, other inputs")
    parser.add_argument("--only", default=",".join(KINDS), help="kinds, separated by commas")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1), help="worker processes")
    parser.add_argument("--replay", metavar="KIND:SEED", help="read one input again, with its traceback")
    given = parser.parse_args()
    unknown = [name for name in given.only.split(",") if name not in KINDS]
    if unknown:
        parser.error(f"--only names {unknown[0]!r}; the kinds are {', '.join(KINDS)}")
    if given.inputs is None and given.seconds is None:
        given.seconds = 60.0
    return given


def main() -> int:
    """Run, print the table; 1 with findings."""
    given = parsed()
    if given.replay:
        return replay(given.replay)
    kinds = []
    for name in given.only.split(","):
        if KINDS[name].needs and importlib.util.find_spec(KINDS[name].needs) is None:
            print(f"skipped {name}: {KINDS[name].needs} is not installed")
        else:
            kinds.append(name)
    if not kinds:
        return 0
    workers = [Worker(kinds) for _ in range(given.workers)]
    run = Run(kinds, given.seed, given.inputs, given.seconds)
    threads = [threading.Thread(target=run.serve, args=(worker,)) for worker in workers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print(run.table())
    for found in run.findings.values():
        for name, seed, outcome in found:
            print(f"python benchmarks/fuzz.py --replay {name}:{seed}  # {outcome.said.splitlines()[0][:150]}")
    return int(bool(run.findings))


if __name__ == "__main__":
    sys.exit(main())
