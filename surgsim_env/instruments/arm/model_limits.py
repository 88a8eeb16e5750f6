"""Limits of an arm's model file, checked before MuJoCo reads it; models that a check cannot judge compile in a child.

MJCF can ask for much in few letters: a texture of 40000 x 40000 pixels, a `<replicate>` of a hundred million. LIMITS
says how much is accepted. What costs in proportion to its text (PLAIN) is counted. Everything else (files that MuJoCo
decodes, convex hulls, plugins, soft bodies, replicas with all that refers to them, muscles) compiles first in a child
process with CHILD_MEMORY and CHILD_SECONDS, where MuJoCo may also end the process. A child takes about half a second;
its verdict holds in this process until a file changes.

This file runs as that child, too, and imports nothing of the project's, so that it starts quickly.
"""

import math
import os
import struct
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.parsers import expat


class Limit(NamedTuple):
    """Largest value that is accepted, its unit, and what else to do."""

    most: float
    unit: str
    way_out: str


FEWER = "simplify the model"
SMALLER = "make it smaller"
# What one model, its includes and its assets may hold together.
LIMITS = {
    "text": Limit(16e6, "bytes of XML", "move data into mesh files"),
    "includes": Limit(100, "included files", "merge them"),
    "levels": Limit(400, "levels of XML elements", FEWER),
    "assets": Limit(200e6, "bytes in files of assets", "reduce the meshes and the pictures"),
    "textures": Limit(256e6, "bytes of textures", "take smaller pictures"),
    "height fields": Limit(16e6, "points of height fields", "take fewer rows and columns"),
    "elements": Limit(10_000, "elements, replicas counted", FEWER),
    "bodies": Limit(2_000, "bodies, replicas counted", FEWER),
    "joints": Limit(500, "joints, replicas counted", FEWER),
    "keyframes": Limit(1_000, "keyframes", "leave them out"),
    "soft points": Limit(20_000, "points of soft bodies", "take fewer points"),
}
# The largest value of single attributes, by element (any, if "") and attribute. Of several numbers, their product.
ATTRIBUTE_LIMITS = {
    ("size", "memory"): Limit(1e9, "bytes", "leave it out"),
    ("size", "nstack"): Limit(1e8, "numbers", "leave it out"),
    ("size", "njmax"): Limit(10_000, "constraints", "leave it out"),
    ("size", "nconmax"): Limit(10_000, "contacts", "leave it out"),
    ("size", "nkey"): Limit(1_000, "keyframes", "leave it out"),
    ("size", "nuserdata"): Limit(1e6, "numbers", "leave it out"),
    **{
        ("size", f"nuser_{kind}"): Limit(100, "numbers", "leave it out")
        for kind in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")
    },
    ("numeric", "size"): Limit(1e6, "numbers", SMALLER),
    ("", "nsample"): Limit(100_000, "samples", SMALLER),
    ("", "actdim"): Limit(1_000, "numbers", SMALLER),
    ("", "cellcount"): Limit(1_000, "cells", SMALLER),
    ("contact", "num"): Limit(10_000, "contacts", SMALLER),
    ("user", "dim"): Limit(10_000, "numbers", SMALLER),
}
# Largest count of numbers in the attribute `user` of any element: MuJoCo makes room for as many in all of its kind.
USER_NUMBERS = Limit(100, "numbers", "leave it out")

# Elements with a limit of their own; the links of URDF are bodies.
COUNTED = {"body": "bodies", "link": "bodies", "key": "keyframes", "joint": "joints", "freejoint": "joints"}

CHILD_MEMORY = 1.5e9  # [bytes] beyond what MuJoCo takes when it starts; on Linux only
CHILD_SECONDS = 20.0
# The child's exit status where MuJoCo ran out of memory, or found the model wrong.
OUT_OF_MEMORY, FAULTY = 3, 4
# Only so much of what a failed child said is quoted [characters].
REASON_LENGTH = 200

# Elements whose cost is in proportion to the text that describes them, their attributes being within ATTRIBUTE_LIMITS.
PLAIN = frozenset(
    (
        # The file and its options
        *("mujoco", "compiler", "option", "flag", "size", "statistic", "visual", "global", "quality", "headlight"),
        *("map", "scale", "rgba", "default", "include", "custom", "numeric", "text", "tuple", "element"),
        # Assets without a file
        *("asset", "texture", "hfield", "material", "layer"),
        # Bodies
        *("worldbody", "body", "frame", "inertial", "joint", "freejoint", "geom", "site", "camera", "light"),
        *("contact", "pair", "exclude", "keyframe", "key"),
        # Tendons, equalities and actuators; `fixed` and `spatial` are tendons
        *("tendon", "fixed", "spatial", "pulley", "equality", "connect", "weld"),
        *("actuator", "general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder"),
        # Sensors with an output of a few numbers
        *("sensor", "touch", "accelerometer", "velocimeter", "gyro", "force", "torque", "magnetometer", "jointpos"),
        *("jointvel", "tendonpos", "tendonvel", "actuatorpos", "actuatorvel", "actuatorfrc", "jointactuatorfrc"),
        *("ballquat", "ballangvel", "jointlimitpos", "jointlimitvel", "jointlimitfrc", "framepos", "framequat"),
        *("framexaxis", "frameyaxis", "framezaxis", "framelinvel", "frameangvel", "framelinacc", "frameangacc"),
        *("subtreecom", "subtreelinvel", "subtreeangmom", "clock", "e_potential", "e_kinetic"),
        # URDF
        *("robot", "link", "origin", "mass", "inertia", "collision", "geometry", "box", "sphere", "capsule", "parent"),
        *("child", "axis", "limit", "dynamics", "safety_controller", "calibration", "mimic", "color"),
    )
)
# Attributes that make an element not plain: a file, and what computes actuator lengths by simulation.
FILES = ("file", "filename", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
NOT_PLAIN = (*FILES, "nsample", "actdim", "gaintype", "biastype", "dyntype")
# Attributes that hold a name, which may be "nan".
NAMES = ("name", "objname", "refname", *FILES)
# Largest finite number of an attribute: products of larger ones overflow.
NUMBER_MOST = 1e100
# Signature of PNG files; width and height follow at byte 16.
PNG = b"\x89PNG\r\n\x1a\n"


def _overflows(word: str) -> bool:
    """Whether a word is a finite number whose products are not."""
    try:
        return NUMBER_MOST < abs(float(word)) < math.inf
    except ValueError:
        return False


def read_xml(path: Path) -> ElementTree.Element:
    """The root element of a model file, whose size, nesting and entities were checked.

    Raises:
        ValueError: a file that cannot be read, is no regular file or no XML, or breaks a limit.
    """
    what = f"model file {path}"
    if os.path.exists(path) and not os.path.isfile(path):
        raise ValueError(f"{what} cannot be read: it is no regular file; name an MJCF or URDF file")
    try:
        size = path.stat().st_size
        data = path.read_bytes() if size <= LIMITS["text"].most else b""
    except OSError as error:
        raise ValueError(f"{what} cannot be read: {error.strerror}") from None
    _check(size, LIMITS["text"], what)
    try:
        levels, entities = _structure(data)
        root = ElementTree.fromstring(data) if levels <= LIMITS["levels"].most and not entities else None
    except (ElementTree.ParseError, expat.ExpatError) as error:
        raise ValueError(f"{what} is not valid XML: {error}") from None
    except (LookupError, ValueError) as error:
        raise ValueError(f"{what} is in an encoding that cannot be read ({error}): save it as UTF-8") from None
    _check(levels, LIMITS["levels"], what)
    if root is None:
        raise ValueError(
            f"{what} declares the entity {entities[0]!r}; entities are not expanded: write what it stands for"
        )
    return root


def _check(value: float, limit: Limit, what: str) -> None:
    most, unit, way_out = limit
    if value > most:
        raise ValueError(f"{what}: {value:.10g} {unit}; at most {most:.10g} are accepted: {way_out}")


def _structure(data: bytes) -> tuple[int, list[str]]:
    """The deepest level of an XML text, and the names of the entities that it declares."""
    parser, level, deepest = expat.ParserCreate(), 0, 0
    entities: list[str] = []

    def enter(*_: object) -> None:
        nonlocal level, deepest
        level += 1
        deepest = max(deepest, level)

    def leave(*_: object) -> None:
        nonlocal level
        level -= 1

    parser.StartElementHandler, parser.EndElementHandler = enter, leave
    parser.EntityDeclHandler = lambda name, *_: entities.append(name)
    parser.Parse(data, True)
    return deepest, entities


def read_spec(path: str, text: str) -> Any:
    """MuJoCo's specification of an MJCF file, or, if `text` is not empty, of that text in the file's place."""
    import mujoco

    if not text:
        return mujoco.MjSpec.from_file(path)
    spec = mujoco.MjSpec.from_string(text)
    spec.modelfiledir = str(Path(path).parent)
    return spec


def check_model(path: Path, root: ElementTree.Element, text: str) -> str:
    """Refuse a model that breaks a limit, or that does not compile within a child's memory and time.

    Args:
        path: of the model file.
        root: its root element.
        text: what MuJoCo will read in its place; empty if the file itself.

    Returns:
        What MuJoCo found wrong with it in the child; empty if nothing, or without a child.

    Raises:
        ValueError: names the file, the element, the value, the limit and the way out.
    """
    count = _Count(path)
    count.add(root, 1)
    count.check()
    if not count.apart:
        return ""
    stamps = tuple((str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in (path, *count.files))
    return _compile_apart(str(path.absolute()), text, stamps)


@dataclass
class _Count:
    """What a model file and its includes ask for."""

    path: Path
    texts: float = 0.0  # [bytes]
    totals: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))  # by names in LIMITS
    files: list[Path] = field(default_factory=list)  # included ones and assets
    folders: set[str] = field(default_factory=lambda: {""})
    inherited: defaultdict[str, float] = field(
        default_factory=lambda: defaultdict(float)
    )  # attributes of textures in <default>
    assets: list[ElementTree.Element] = field(default_factory=list)
    replicas: float = 0.0  # largest count of a <replicate>
    apart: bool = False

    def add(self, root: ElementTree.Element, times: int, *, level: int = 1, default: bool = False) -> None:
        """Count an element and all in it `times` times; `default` is whether it is in <default>."""
        _check(level, LIMITS["levels"], f"model file {self.path} with its included files")
        # MuJoCo compares the names of elements without regard to case.
        tag = root.tag.lower() if isinstance(root.tag, str) else ""
        self._count(root, tag, times, default)
        if tag == "replicate":
            replicas = _number(root.get("count", "1"))
            self.replicas = max(self.replicas, replicas)
            times *= max(int(replicas), 1) if math.isfinite(replicas) else 1
        for part in (*root, *(self._included(root) if tag == "include" else ())):
            self.add(part, times, level=level + 1, default=default or tag == "default")

    def _count(self, element: ElementTree.Element, tag: str, times: int, default: bool) -> None:
        self.totals["elements"] += times
        kind = COUNTED.get(tag)
        if kind and not default:
            self.totals[kind] += times
        for attribute, value in element.attrib.items():
            self._check_attribute(element, tag, attribute, value)
            self.apart |= attribute in NOT_PLAIN and tag != "include"
        self.apart |= tag not in PLAIN
        if tag == "compiler":
            self.folders |= {element.get(name, "") for name in ("assetdir", "meshdir", "texturedir")}
        elif tag == "texture" and default:
            for attribute in ("width", "height", "nchannel"):
                self.inherited[attribute] = max(self.inherited[attribute], _number(element.get(attribute, "0")))
        elif tag == "flexcomp":
            self.totals["soft points"] += times * _product(element.get("count", "10 10 10"))
        if not default and tag != "include" and (tag in ("texture", "hfield") or element.attrib.keys() & FILES):
            self.assets.append(element)

    def _check_attribute(self, element: ElementTree.Element, tag: str, attribute: str, value: str) -> None:
        what = f"model file {self.path}: <{tag}{_named(element)} {attribute}={_shown(value)}>"
        # MuJoCo prints a warning and compiles it into something.
        if attribute not in NAMES and {"nan", "+nan", "-nan"} & set(value.lower().split()):
            raise ValueError(f"{what} is not a number; write one")
        if attribute not in NAMES and any(map(_overflows, value.split())):
            raise ValueError(f"{what} is too large a number; at most {NUMBER_MOST:g} is possible: write a smaller one")
        if attribute == "user":
            _check(len(value.split()), USER_NUMBERS, what)
        limit = ATTRIBUTE_LIMITS.get((tag, attribute)) or ATTRIBUTE_LIMITS.get(("", attribute))
        if limit is not None:
            _check(_bytes(value) if attribute == "memory" else _product(value), limit, what)

    def _included(self, element: ElementTree.Element) -> Iterator[ElementTree.Element]:
        """What an included file adds; MuJoCo looks for it beside the model, and includes each file once."""
        file = self.path.parent / element.get("file", "")
        # A file that is elsewhere is found by MuJoCo, or not.
        self.apart |= not os.path.isfile(file)
        if not os.path.isfile(file) or file in self.files or file == self.path:
            return
        self.files.append(file)
        self.totals["includes"] += 1
        self.texts += file.stat().st_size
        what = f"model file {self.path} with {file.name} and the files included before"
        _check(self.totals["includes"], LIMITS["includes"], what)
        _check(self.texts + self.path.stat().st_size, LIMITS["text"], what)
        yield from read_xml(file)

    def check(self) -> None:
        """Refuse totals beyond LIMITS."""
        for element in self.assets:
            self._weigh(element)
        largest = f" with <replicate count={self.replicas:.10g}>" if self.replicas else ""
        for name, value in self.totals.items():
            _check(value, LIMITS[name], f"model file {self.path}{largest}")

    def _weigh(self, element: ElementTree.Element) -> None:
        """Add the sizes of an asset's files, pixels and points."""
        tag = element.tag.lower()
        what = f"model file {self.path}: <{tag}{_named(element)}>"
        for name in FILES:
            for file in self._found(element.get(name, "")):
                self.files.append(file)
                self.totals["assets"] += file.stat().st_size
                width, height = _png_size(file)
                self._add_picture(tag, width, height, element, f"{what} with {file.name} of {width} x {height} pixels")
        if tag == "texture" and element.get("builtin", "none") != "none":
            sides = [_number(element.get(name, self.inherited[name])) for name in ("width", "height")]
            if element.get("type", "cube") != "2d":
                sides[1] = max(sides[1], 6.0 * sides[0])
            self._add_picture(tag, sides[0], sides[1], element, f"{what} of {sides[0]:.10g} x {sides[1]:.10g} pixels")
        elif tag == "hfield":
            sides = [_number(element.get(name, "0")) for name in ("nrow", "ncol")]
            self._add_picture(tag, sides[0], sides[1], element, f"{what} of {sides[0]:.10g} x {sides[1]:.10g} points")

    def _add_picture(self, tag: str, width: float, height: float, element: ElementTree.Element, what: str) -> None:
        name = "height fields" if tag == "hfield" else "textures"
        channels = _number(element.get("nchannel", self.inherited["nchannel"] or 3)) if name == "textures" else 1
        self.totals[name] += width * height * channels
        _check(self.totals[name], LIMITS[name], what)

    def _found(self, name: str) -> Iterator[Path]:
        """The file of an asset, in any of the folders that the compiler may be told of."""
        if not name:
            return
        # A package's URI, as in package://arm/meshes/link.stl, is found by its last part beside the model.
        for folder in sorted(self.folders):
            for ending in (name, Path(name).name):
                file = self.path.parent / folder / ending
                if os.path.exists(file):
                    if not os.path.isfile(file):
                        raise ValueError(f"model file {self.path}: asset {file} is no regular file: put a file there")
                    yield file
                    return


def _named(element: ElementTree.Element) -> str:
    name = element.get("name")
    return f" name={_shown(name)}" if name else ""


def _shown(value: str) -> str:
    return repr(value if len(value) <= 40 else f"{value[:40]}...")


def _number(text: Any) -> float:
    """The number of an attribute; 0 for what MuJoCo will refuse, infinity for none."""
    try:
        number = float(text)
    except ValueError:
        return 0.0
    return number if number == number else math.inf


def _product(text: str) -> float:
    return math.prod(max(_number(word), 1.0) for word in text.split())


def _bytes(text: str) -> float:
    """The size "16M" [bytes]."""
    units = "KMGTPE"
    place = units.find(text[-1:].upper()) if text else -1
    return _number(text[:-1]) * 1024 ** (place + 1) if place >= 0 else _number(text)


def _png_size(file: Path) -> tuple[int, int]:
    """Width and height that a PNG file states [pixels]; 0 for other files, whose content is no larger than they are."""
    with file.open("rb") as stream:
        head = stream.read(24)
    return struct.unpack(">II", head[16:24]) if head.startswith(PNG) and len(head) == 24 else (0, 0)


@lru_cache(maxsize=64)
def _compile_apart(path: str, text: str, stamps: tuple[tuple[str, int, int], ...]) -> str:
    """Compile a model in a child process; what MuJoCo found wrong with it, or "".

    The verdict is kept until `stamps` change: names, sizes and times of its files. A refusal is tried again.

    Raises:
        ValueError: it took too much memory or time, or ended the child.
    """
    what = f"model file {path}"
    out = "take fewer or smaller meshes, pictures and soft bodies"
    settings = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
    # MuJoCo writes a log into the current folder.
    with tempfile.TemporaryDirectory(prefix="surgsim-") as folder:
        try:
            done = subprocess.run(
                [sys.executable, "-P", str(Path(__file__).absolute()), path, f"{CHILD_MEMORY:.0f}"],
                input=text,
                encoding="utf-8",
                errors="replace",
                capture_output=True,
                timeout=CHILD_SECONDS,
                cwd=folder,
                env={**os.environ, **settings, "PYTHONIOENCODING": "utf-8:replace"},
            )
        except subprocess.TimeoutExpired:
            raise ValueError(f"{what} was not compiled within {CHILD_SECONDS:g} s: {out}") from None
    if done.returncode == OUT_OF_MEMORY:
        raise ValueError(f"{what} takes more than {CHILD_MEMORY / 1e9:g} GB of memory to compile: {out}")
    if done.returncode < 0:
        raise ValueError(f"{what} ends MuJoCo by signal {-done.returncode} as it is compiled: {out}")
    if done.returncode not in (0, FAULTY):
        said = " ".join(done.stderr.split())[-REASON_LENGTH:]
        raise ValueError(f"{what} could not be tried in a process of its own, which ended with {said!r}: run it again")
    return done.stdout if done.returncode == FAULTY else ""


def _try() -> int:
    """Compile the model of a path, or of standard input in its place, within so many bytes; the exit status."""
    path, memory, text = sys.argv[1], int(sys.argv[2]), sys.stdin.read()
    import mujoco

    if sys.platform == "linux":
        import resource

        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + memory, taken + memory))
    try:
        mujoco.MjData(read_spec(path, text).compile())
    except (MemoryError, ValueError, TypeError, RuntimeError, mujoco.FatalError) as error:
        print(error)
        # How its C++ code tells that there is no memory.
        told = ("Could not allocate memory", "unknown exception", "bad_alloc")
        return OUT_OF_MEMORY if isinstance(error, MemoryError) or any(t in str(error) for t in told) else FAULTY
    return 0


if __name__ == "__main__":
    sys.exit(_try())
