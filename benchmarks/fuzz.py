"""Mutated files of the project's input formats: each must be valid, or be refused by one line.

    python benchmarks/fuzz.py --seconds 60
    python benchmarks/fuzz.py --inputs 1000 --seed 3 --only meshes,arms
    python benchmarks/fuzz.py --replay arms:17

Valid inputs come from shipped files; one to three mutations of their structure (a number becomes NaN, infinite,
negative, huge or 0; keys are dropped, added, of another type; lines doubled) or of their bytes (flipped, cut, doubled)
make each input. A finding is an exception other than a refusal in one line, an ended process, or more than 60 s. A
worker process reads the inputs, so that a crash is a finding too. Prints a table; 1 with findings.
"""

import argparse
import gzip
import json
import math
import multiprocessing
import os
import re
import resource
import struct
import sys
import tempfile
import time
import tomllib
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

REPOSITORY = Path(__file__).resolve().parents[1]
# Packages with refusals as errors.
OURS = ("msdm_core", "surgsim_env", "surgsim_apps")
SECONDS_MOST = 60.0  # for one input
ADDRESS_SPACE = 16_000_000_000  # of the worker [bytes]: a table for an odd count is refused at once
START_SECONDS = 600.0  # for the worker's start, with imports of libraries
PREFIX = "surgsim-fuzz-"  # of temporary folders
MESSAGE_LONGEST = 1500  # [characters]
# Odd numbers, as text.
ODD = (
    *("nan", "inf", "-inf", "0", "-1", "1", "2", "1e308", "-1e308", "1e-320", "1e9", "-1e9", "65536", "0.5"),
    *("2147483647", "2147483648", "-2147483648", "9223372036854775807", "18446744073709551616"),
)

# The files of an input by name; the first is read.
Files = dict[str, bytes]
Mutation = Callable[[bytes, Generator], tuple[bytes, str]]


@dataclass(frozen=True)
class Kind:
    """Inputs of one kind: makes valid ones in a folder, and reads the first file of one."""

    name: str
    cases: Callable[[Path], Iterator[Files]]
    read: Callable[[Path], object]


class Outcome(NamedTuple):
    """Result of one input: "valid", "refused" or "finding", and the message of its error."""

    status: str
    message: str


# ---- valid inputs and their readers -----------------------------------------------------------------------------


def mesh_cases(folder: Path) -> Iterator[Files]:
    import meshio
    import trimesh

    from msdm_core.mesh import TetMesh
    from msdm_core.mesh_files import write_mesh
    from msdm_core.meshing import box_mesh

    block = box_mesh((0.04, 0.03, 0.02), (4, 3, 2))
    region = (block.points[block.tets].mean(axis=1)[:, 0] > 0.02).astype(np.int32)
    mesh = TetMesh(block.points, block.tets, region, {0: "liver", 1: "lesion"})
    write_mesh(folder / "a.vtu", mesh)
    for name, file_format in (("a.vtu", "vtu"), ("a.vtk", "vtk"), ("a.msh", "gmsh22"), ("a.mesh", "medit")):
        meshio.read(folder / "a.vtu").write(folder / name, file_format=file_format)
        yield {name: (folder / name).read_bytes()}
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    for name in ("a.stl", "a.ply", "a.obj"):
        ball.export(folder / name)
        yield {name: (folder / name).read_bytes()}


def cells_of(size: float) -> Any:
    """Cells of one size [m]."""
    from surgsim_apps.patient.meshers import Cells

    return Cells(size, is_given=True, coarsening=1, fine_depth=0.0, approach=(0.0, 0.0, -1.0), face_angle_deg=60.0)


def read_mesh_file(path: Path) -> object:
    from msdm_core.mesh_files import SURFACE_SUFFIXES, read_mesh
    from surgsim_apps.patient.meshers import mesh_surfaces, read_surfaces

    if path.suffix in SURFACE_SUFFIXES:
        return mesh_surfaces(read_surfaces([path], "m", mend=False), cells=cells_of(0.01), mesher="lattice")
    return read_mesh(path, length_unit="m")


def scene_cases(_folder: Path) -> Iterator[Files]:
    from surgsim_env.scene import scenes_folder

    for name in ("phantom_small", "phantom", "lobe", "agarose_prism", "bovine_liver_block"):
        yield {f"{name}.toml": (scenes_folder() / "organs" / f"{name}.toml").read_bytes()}


def read_scene(path: Path) -> object:
    from surgsim_env.scene import load_anatomy, make_scene

    anatomy = load_anatomy(make_scene(path))
    return anatomy.organ(anatomy.demonstration_lesions())


def image_cases(folder: Path) -> Iterator[Files]:
    import nibabel
    import SimpleITK

    grid = np.stack(np.meshgrid(*map(np.arange, (20, 18, 16)), indexing="ij"), axis=-1)
    organ = (((grid - [9.5, 8.5, 7.5]) / [8.0, 7.0, 6.0]) ** 2).sum(axis=-1) <= 1.0
    lesion = ((grid - [12.0, 8.0, 8.0]) ** 2).sum(axis=-1) <= 6.0
    labels = np.where(lesion, 2, organ).astype(np.uint8)
    image = nibabel.Nifti1Image(labels, np.diag([-4.0, -4.0, 4.0, 1.0]))
    image.header.set_xyzt_units("mm")
    nibabel.save(image, folder / "a.nii")
    data = (folder / "a.nii").read_bytes()
    yield {"a.nii": data}
    yield {"a.nii.gz": gzip.compress(data, mtime=0)}
    whole = SimpleITK.Cast(SimpleITK.GetImageFromArray(labels.T), SimpleITK.sitkUInt16)
    whole.SetSpacing((4.0, 4.0, 4.0))
    # A damaged MetaImage header may end the process in ITK.
    for name in ("a.nrrd", "a.dcm"):
        SimpleITK.WriteImage(whole, str(folder / name))
        yield {name: (folder / name).read_bytes()}


def read_image(path: Path) -> object:
    from surgsim_apps.patient.label_image import parse_labels, read_label_image
    from surgsim_apps.patient.meshers import mesh_image

    image = read_label_image(path, parse_labels("liver=1,lesion=2"))
    return mesh_image(image, path.name, cells=cells_of(0.012), mesher="lattice", mend=True)


def arm_cases(_folder: Path) -> Iterator[Files]:
    from surgsim_env.scene import scenes_folder

    instruments = scenes_folder() / "instruments"
    for name in ("psm_palpator", "psm_grasper", "psm_retractor", "six_axis"):
        yield {f"{name}{end}": (instruments / f"{name}{end}").read_bytes() for end in (".toml", ".xml")}


def read_arm(path: Path) -> object:
    from surgsim_env.instruments import load_arm

    arm = load_arm(path)
    return arm.tip_pose(arm.home)


def csv_cases(folder: Path) -> Iterator[Files]:
    times = np.linspace(0.0, 0.3, 31)
    table = np.stack([times, 0.01 * np.sin(times), 0.01 * np.cos(times), -0.001 * times, np.arange(31) % 2], axis=1)
    np.savetxt(folder / "one.csv", table, delimiter=",", header="time,x,y,z,buttons", comments="")
    yield {"one.csv": (folder / "one.csv").read_bytes()}


def read_csv(path: Path) -> object:
    from surgsim_apps.haptics.trajectory import TrajectoryDevice

    return TrajectoryDevice.load(path).read()


KINDS = {
    kind.name: kind
    for kind in (
        Kind("meshes", mesh_cases, read_mesh_file),
        Kind("scenes", scene_cases, read_scene),
        Kind("images", image_cases, read_image),
        Kind("arms", arm_cases, read_arm),
        Kind("csv", csv_cases, read_csv),
    )
}

# ---- mutations --------------------------------------------------------------------------------------------------


def pick(rng: Generator, things: Any) -> Any:
    return things[int(rng.integers(len(things)))]


def mutate_toml(data: bytes, rng: Generator) -> tuple[bytes, str]:
    """A table with one entry dropped, added, or of another value or type."""
    import tomlkit

    table = tomllib.loads(data.decode())
    places: list[tuple[Any, Any]] = []

    def visit(part: Any) -> None:
        keys = part.keys() if isinstance(part, dict) else range(len(part)) if isinstance(part, list) else ()
        for key in keys:
            places.append((part, key))
            visit(part[key])

    visit(table)
    part, key = pick(rng, places)
    kind = pick(rng, ("number", "number", "number", "odd", "drop", "add", "swap"))
    odd = pick(rng, (True, "", "x" * 300, "../../etc/passwd", "ä\u2028", [], {}, [1.0, 2.0], ["a", 1], {"a": {"b": 1}}))
    if kind == "drop":
        del part[key]
    elif kind == "add" and isinstance(part, dict):
        part[pick(rng, ("x", "name", "file", "radius", f"{key}s"))] = odd
    elif kind == "swap":
        other, second = pick(rng, places)
        part[key] = json.loads(json.dumps(other[second], default=str))
    elif kind == "number" and isinstance(part[key], int | float | list):
        value = float(pick(rng, ODD))
        part[key] = int(value) if isinstance(part[key], int) and math.isfinite(value) else value
    else:
        part[key] = odd
    return tomlkit.dumps(table).encode(), f"{kind} at {key!r}"


def mutate_text(data: bytes, rng: Generator) -> tuple[bytes, str]:
    """Lines dropped, doubled or swapped, or a number replaced by an odd one."""
    text = data.decode("latin-1")
    kind = pick(rng, ("number", "number", "number", "number", "drop line", "double line", "swap lines", "word"))
    if kind in ("number", "word"):
        pattern = r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w])" if kind == "number" else r"[A-Za-z_]{3,}"
        matches = list(re.finditer(pattern, text[:200_000]))
        if not matches:
            return mutate_bytes(data, rng)
        old = pick(rng, matches)
        new = pick(rng, ODD) if kind == "number" else pick(rng, matches).group()
        return f"{text[: old.start()]}{new}{text[old.end() :]}".encode("latin-1"), f"{old.group()!r} becomes {new!r}"
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
    kind = pick(rng, ("flip", "flip", "cut", "drop", "double", "number", "number"))
    # Half of the places are within the first kilobyte, with the headers.
    first = int(rng.integers(min(size, 1024) if rng.random() < 0.5 else size))
    length = int(rng.integers(1, 64))
    if kind == "flip":
        new[first] ^= 1 << int(rng.integers(8))
    elif kind == "cut":
        del new[first:]
    elif kind == "drop":
        del new[first : first + length]
    elif kind == "double":
        new[first:first] = new[first : first + length]
    else:
        form = pick(rng, ("<f", "<d", "<i", "<h"))
        value = pick(rng, (0, -1, 1, 32767)) if form[1] in "ih" else pick(rng, (math.nan, math.inf, -1.0, 0.0, 1e30))
        first -= first % struct.calcsize(form)
        new[first : first + struct.calcsize(form)] = struct.pack(form, value)
    return bytes(new), f"{kind} at byte {first} of {size}"


def mutate_header(data: bytes, rng: Generator) -> tuple[bytes, str]:
    """The text header of an NRRD file."""
    end = data.find(b"\n\n")
    head, what = mutate_text(data[: end + 1], rng)
    return head + data[end + 1 :], what


def mutate_packed(data: bytes, rng: Generator) -> tuple[bytes, str]:
    inside, what = mutate_bytes(gzip.decompress(data), rng)
    return gzip.compress(inside, 1, mtime=0), f"unpacked: {what}"


STRUCTURES: dict[str, Mutation] = {
    ".toml": mutate_toml,
    ".gz": mutate_packed,
    ".nrrd": mutate_header,
    ".nii": mutate_bytes,
    ".dcm": mutate_bytes,
}


def mutated(files: Files, rng: Generator) -> tuple[Files, str]:
    """An input after one to three mutations, and these in words."""
    files, words = dict(files), []
    for _ in range(int(pick(rng, (1, 1, 2, 3)))):
        name = pick(rng, list(files))
        structure = STRUCTURES.get(Path(name).suffix, mutate_text)
        try:
            files[name], what = (structure if rng.random() < 0.7 else mutate_bytes)(files[name], rng)
        except Exception:
            # An earlier mutation has left no structure, or the writer refuses the odd value.
            files[name], what = mutate_bytes(files[name], rng)
        words.append(f"{name}: {what}")
    return files, "; ".join(words)


def mutated_input(kind: Kind, cases: list[Files], seed: int) -> tuple[Files, str]:
    """The input of a seed: the same on every run."""
    rng = np.random.default_rng([zlib.crc32(kind.name.encode()), seed])
    return mutated(pick(rng, cases), rng)


# ---- reading ----------------------------------------------------------------------------------------------------


def refusal_fault(error: Exception) -> str:
    """The fault of an error as a refusal; empty for a right one."""
    text, name = str(error), type(error).__name__
    module = type(error).__module__.partition(".")[0]
    last = traceback.extract_tb(error.__traceback__)[-1].filename
    if isinstance(error, OSError):
        ours = error.filename is not None
    elif type(error) is not ValueError and module not in OURS:
        return f"{name}: {text[:300]}"
    else:
        ours = any(Path(last).is_relative_to(REPOSITORY / package) for package in OURS)
    if not ours:
        return f"{name} of a library: {text[:300]}"
    if "\n" in text.strip() or len(text) > MESSAGE_LONGEST or not text:
        return f"message of {len(text.splitlines())} lines and {len(text)} characters: {text[:300]!r}"
    return ""


def attempt(kind: Kind, files: Files) -> Outcome:
    """Read an input in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix=PREFIX) as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, data in files.items():
            Path(folder, name).write_bytes(data)
        try:
            kind.read(Path(folder, next(iter(files))))
        # Any exception is judged.
        except Exception as error:
            fault = refusal_fault(error)
            message = f"{fault}\n{traceback.format_exc()}" if fault else str(error)
            return Outcome("finding" if fault else "refused", message)
    return Outcome("valid", "")


def valid_inputs(kind: Kind) -> list[Files]:
    """The unmutated inputs of a kind."""
    with tempfile.TemporaryDirectory(prefix=PREFIX) as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return list(kind.cases(Path(folder)))


def work(kinds: list[str], pipe: Connection) -> None:
    """Read inputs by kind and seed from a pipe, until the process is ended."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(silence, stream)
    cases = {name: valid_inputs(KINDS[name]) for name in kinds}
    pipe.send("ready")
    while True:
        name, seed = pipe.recv()
        files, _ = mutated_input(KINDS[name], cases[name], seed)
        pipe.send(attempt(KINDS[name], files))


class Worker:
    """A process for reading inputs, started again after its end."""

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
            raise SystemExit(f"fuzz: the worker did not start within {START_SECONDS:g} s")
        self.pipe.recv()

    def read(self, kind: str, seed: int) -> Outcome:
        """The outcome of an input; an ended or too slow process is a finding."""
        try:
            self.pipe.send((kind, seed))
            if self.pipe.poll(SECONDS_MOST):
                return self.pipe.recv()
            fault = f"more than {SECONDS_MOST:g} s"
        except (EOFError, ConnectionError):
            fault = "the process ended"
        self.close()
        self._start()
        return Outcome("finding", fault)

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


# ---- the run ----------------------------------------------------------------------------------------------------


def run(kinds: list[str], first_seed: int, inputs: int | None, seconds: float) -> int:
    """Read inputs of each kind in turn until a number or a time is over; print the table, 1 with findings."""
    counts = {name: Counter[str]() for name in kinds}
    worker, end, seed = Worker(kinds), time.perf_counter() + seconds, first_seed * 1_000_000
    while (seed % 1_000_000 < inputs) if inputs else time.perf_counter() < end:
        for name in kinds:
            outcome = worker.read(name, seed)
            counts[name][outcome.status] += 1
            if outcome.status == "finding":
                print(f"finding --replay {name}:{seed}: {outcome.message.splitlines()[0]}", flush=True)
        seed += 1
    worker.close()
    print(f"{'kind':<10}{'inputs':>8}{'valid':>8}{'refused':>9}{'findings':>10}")
    for name, count in counts.items():
        columns = f"{count['valid']:>8}{count['refused']:>9}{count['finding']:>10}"
        print(f"{name:<10}{sum(count.values()):>8}{columns}")
    return int(any(count["finding"] for count in counts.values()))


def replay(text: str) -> int:
    """Read one input again in this process; print its mutations and the result."""
    name, _, seed = text.partition(":")
    if name not in KINDS or not seed.isdigit():
        raise SystemExit(f"fuzz: --replay is {text!r}; the form is KIND:SEED with a kind of {', '.join(KINDS)}")
    kind = KINDS[name]
    files, mutation = mutated_input(kind, valid_inputs(kind), int(seed))
    print(f"{text}: {mutation}", flush=True)
    outcome = attempt(kind, files)
    print(f"{outcome.status}: {outcome.message}")
    return int(outcome.status == "finding")


def main() -> int:
    """Run or replay by the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, help="number of inputs of each kind, in place of --seconds")
    parser.add_argument("--seconds", type=float, default=60.0, help="duration [s]")
    parser.add_argument("--seed", type=int, default=0, help="another number, other inputs")
    parser.add_argument("--only", default=",".join(KINDS), help="kinds, separated by commas")
    parser.add_argument("--replay", metavar="KIND:SEED", help="read one input again, with its traceback")
    options = parser.parse_args()
    if options.replay:
        return replay(options.replay)
    kinds = options.only.split(",")
    unknown = [name for name in kinds if name not in KINDS]
    if unknown:
        parser.error(f"--only names {unknown[0]!r}; the kinds are {', '.join(KINDS)}")
    # An ended worker leaves its files there.
    with tempfile.TemporaryDirectory(prefix=PREFIX) as os.environ["TMPDIR"]:
        return run(kinds, options.seed, options.inputs, options.seconds)


if __name__ == "__main__":
    sys.exit(main())
