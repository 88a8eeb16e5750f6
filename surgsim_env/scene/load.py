"""Scene files read into dataclasses, every entry checked; shipped scenes and arms by name."""

import tomllib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import dacite

from msdm_core.errors import OrganError
from surgsim_env.scene.model import CARTESIAN, PAIRS, LibraryMaterial, Scene

Table = TypeVar("Table")
PACKAGE_FOLDER = Path(__file__).resolve().parents[1]


class _EntryError(dacite.DaciteFieldError):
    """An entry with a wrong value; dacite adds the path of the entry."""

    def __init__(self, reason: str) -> None:
        super().__init__()
        self.reason = reason

    def __str__(self) -> str:
        return f"{self.field_path}: {self.reason}"


def scenes_folder() -> Path:
    """The folder with `organs/`, `instruments/` and `meshes/`; as `_shipped_folder`."""
    return _shipped_folder(PACKAGE_FOLDER / "assets", PACKAGE_FOLDER.parent / "scenes", "organs", "scene files")


def agents_folder() -> Path:
    """The folder with `policies/` and `results/` of agents; as `_shipped_folder`."""
    agents = PACKAGE_FOLDER / "assets" / "agents"
    return _shipped_folder(agents, PACKAGE_FOLDER.parent / "agents", "policies", "policies of agents")


def _shipped_folder(packed: Path, checkout: Path, inside: str, what: str) -> Path:
    """The place of data that are shipped.

    A wheel carries them inside the package, a checkout next to the package. Both are looked for beside this file and
    nowhere else: an editable install also leaves a copy in site-packages, which goes stale and is never read.

    Args:
        packed: the place in a wheel.
        checkout: the place in a checkout.
        inside: a folder that it has.
        what: the data, for the message.

    Raises:
        FileNotFoundError: neither place has it; names both and the way out.
    """
    for place in (packed, checkout):
        if (place / inside).is_dir():
            return place
    raise FileNotFoundError(
        f"surgsim's {what} are neither in {packed} nor in {checkout} (a folder with `{inside}` in it is expected); "
        "reinstall surgsim, or run from a complete checkout"
    )


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """The table in a TOML file; a ValueError names a file that cannot be read, or where it is no valid TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{what} file {path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"{what} file {path} is not valid TOML: {error}") from None


def fill(kind: type[Table], table: dict[str, Any], where: str) -> Table:
    """Fill a dataclass from a table of a TOML file, with every entry checked.

    Args:
        kind: the dataclass.
        table: its entries.
        where: what holds the table, for messages.

    Raises:
        ValueError: an unknown entry (suggests the nearest), a missing or a wrong one; the message begins with `where`.
    """
    lists = {hint: _listed for part in dataclasses_in(kind) for hint in _tuples_in(*get_type_hints(part).values())}
    hooks: dict[Any, Any] = {float: _real, **lists}
    try:
        return dacite.from_dict(kind, table, dacite.Config(strict=True, cast=[tuple], type_hooks=hooks))
    except dacite.UnexpectedDataError as error:
        entry = sorted(map(str, error.keys))[0]
        known = sorted({one.name for part in dataclasses_in(kind) for one in fields(part)})
        raise ValueError(f"{where}: entry {entry!r} is unknown there{nearest(entry, known)}") from None
    except (dacite.DaciteError, OrganError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{where}: {error}") from None


def dataclasses_in(kind: Any) -> Iterator[Any]:
    """A dataclass and those in its fields, at any depth; of another type, the dataclasses in its arguments."""
    if is_dataclass(kind):
        yield kind
        for hint in get_type_hints(kind).values():
            yield from dataclasses_in(hint)
    for part in get_args(kind):
        yield from dataclasses_in(part)


def _tuples_in(*hints: Any) -> Iterator[Any]:
    """The tuple types among type hints and their arguments."""
    for hint in hints:
        if get_origin(hint) is tuple:
            yield hint
        yield from _tuples_in(*get_args(hint))


def nearest(name: str, known: list[str], likeness: float = 0.6) -> str:
    """A hint at the nearest known name, at least so like (0 to 1), or an empty string."""
    found = get_close_matches(name, known, n=1, cutoff=likeness)
    return f"; did you mean {found[0]!r}?" if found else ""


def _listed(value: Any) -> Any:
    # Python would make a tuple of a table's keys, or of a text's letters.
    if not isinstance(value, list | tuple):
        raise _EntryError(f"{value!r} is not a list")
    return value


def _real(value: Any) -> Any:
    """Accept 5000 for 5000.0, which TOML tells apart."""
    return float(value) if isinstance(value, int) else value


def list_scenes() -> list[str]:
    """Names of the scenes that are shipped."""
    return sorted(path.stem for path in (scenes_folder() / "organs").glob("*.toml"))


def make_scene(name: str | Path) -> Scene:
    """The scene of a name (see `list_scenes`) or of a TOML file's path.

    Raises:
        ValueError: an unknown name (lists the known, suggests the nearest) or a file that breaks the format.
    """
    name = str(name)
    if name.endswith(".toml"):
        return load_scene(Path(name))
    known = list_scenes()
    if name not in known:
        raise ValueError(f"scene {name!r} is unknown; the scenes are {', '.join(known)}{nearest(name, known, 0.4)}")
    return load_scene(scenes_folder() / "organs" / f"{name}.toml")


def with_instrument(scene: Scene, instrument: str | None) -> Scene:
    """The scene with another instrument: a name in CARTESIAN or PAIRS, an arm, its path, a pair; None: its own."""
    if instrument is None:
        return scene
    known = [*CARTESIAN, *list_arms(), *PAIRS]
    if Path(instrument).suffix != ".toml" and instrument not in known and pair_names(str(instrument)) is None:
        raise ValueError(
            f"instrument {str(instrument)!r} is unknown{nearest(str(instrument), known)}; the instruments are "
            f"{', '.join(known)}, the path of an arm's TOML file, or two arms as LEFT+RIGHT"
        )
    model = f"{instrument}.xml" if instrument in CARTESIAN else str(instrument)
    return replace(scene, instrument=replace(scene.instrument, model=model))


def pair_names(model: str) -> tuple[str, str] | None:
    """Left and right arm of a pair: a name in PAIRS, or two arms joined by "+"; None for any other instrument."""
    known = list_arms()
    for place in (place for place, sign in enumerate(model) if sign == "+"):
        left, right = model[:place], model[place + 1 :]
        if all(name in known or Path(name).suffix == ".toml" for name in (left, right)):
            return left, right
    return PAIRS.get(model)


def load_scene(path: Path) -> Scene:
    """Read a scene file; a ValueError names the file, the entry and its fault."""
    return scene_from_table(read_toml(path, "scene"), name=path.stem, folder=path.parent)


def scene_from_table(table: dict[str, Any], *, name: str, folder: Path) -> Scene:
    """A scene from the table of a scene file; paths in it are relative to `folder`.

    A table `material` with a `name` is the library's material of that name, its own entries on top; a table `family`
    with a `template` likewise has the entries of that scene's file under those of this one.
    """
    table = _with_template(table, f"scene {name!r}", folder)
    table = _with_library_materials(table, f"scene {name!r}", folder)
    return fill(Scene, {**table, "name": name, "folder": folder}, f"scene {name!r}")


def _with_template(table: dict[str, Any], where: str, folder: Path) -> dict[str, Any]:
    """The table of a scene file over that of the scene which its family names as the template, if it names one."""
    family = table.get("family")
    if not isinstance(family, dict) or "template" not in family:
        return table
    named = family["template"]
    template = read_toml(folder / named, "scene")
    if "family" in template:
        raise ValueError(f"{where}: family.template {named!r} has a family of its own; name the scene of one organ")
    own = {name: value for name, value in family.items() if name != "template"}
    return _laid_over(template, {**table, "family": own})


def list_materials() -> list[str]:
    """Names of the materials in the library."""
    return sorted(path.stem for path in (scenes_folder() / "materials").glob("*.toml"))


def make_material(name: str | Path) -> LibraryMaterial:
    """The material of a name (see `list_materials`) or of a TOML file's path, with its source.

    Raises:
        ValueError: an unknown name (lists the known, suggests the nearest) or a file that breaks the format.
    """
    path, table = _material_table(name, Path())
    return fill(LibraryMaterial, {**table, "name": path.stem}, f"material {path.stem!r}")


def _material_table(name: Any, folder: Path) -> tuple[Path, dict[str, Any]]:
    """Path and contents of a material's file."""
    if str(name).endswith(".toml"):
        path = folder / name
    else:
        known = list_materials()
        if name not in known:
            raise ValueError(
                f"material {str(name)!r} is unknown{nearest(str(name), known, 0.4)}; the materials are "
                f"{', '.join(known)} (`surgsim materials`), or the path of a material's TOML file"
            )
        path = scenes_folder() / "materials" / f"{name}.toml"
    return path, read_toml(path, "material")


def _with_library_materials(table: dict[str, Any], where: str, folder: Path) -> dict[str, Any]:
    """The table of a scene file with the library's numbers in place of the names of its materials."""
    table = dict(table)
    if "material" in table:
        table["material"] = _with_library_material(table["material"], f"{where}: material", folder)
    if isinstance(regions := table.get("regions"), list | tuple):
        table["regions"] = [
            {**one, "material": _with_library_material(one["material"], f"{where}: regions[{number}].material", folder)}
            if isinstance(one, dict) and "material" in one
            else one
            for number, one in enumerate(regions)
        ]
    return table


def _with_library_material(entries: Any, where: str, folder: Path) -> Any:
    """The entries of a table `material`, those of the library under them if it has a `name`."""
    if not isinstance(entries, dict) or "name" not in entries:
        return entries
    try:
        _, table = _material_table(entries["name"], folder)
    except ValueError as error:
        raise ValueError(f"{where}.name: {error}") from None
    return _laid_over(table["material"], {key: value for key, value in entries.items() if key != "name"})


def _laid_over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Tables merged at every depth, the entries of `above` on top."""
    both = {**below, **above}
    for key, value in above.items():
        if isinstance(value, dict) and isinstance(below.get(key), dict):
            both[key] = _laid_over(below[key], value)
    return both


def make_retract_scene(name: str | Path) -> Scene:
    """The retraction scene of a name or path: the scene itself, or the one of the same organ to which it refers.

    Raises:
        ValueError: as in `make_scene`; the scene states why its organ cannot be retracted.
    """
    scene = make_scene(name)
    if scene.retract is not None or (scene.retract_scene is None and scene.retract_refusal is None):
        return scene
    if scene.retract_scene is None:
        raise ValueError(f"scene {scene.name!r} cannot be retracted: {scene.retract_refusal}")
    return load_scene(scene.folder / scene.retract_scene)


def list_arms() -> list[str]:
    """Names of the arms that are shipped."""
    return sorted(path.stem for path in (scenes_folder() / "instruments").glob("*.toml"))
