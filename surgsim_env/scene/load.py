"""Scene files read into dataclasses with all entries checked; shipped scenes and arms by name."""

import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import dacite

from msdm_core.errors import OrganError
from msdm_core.mesh_files.mesh_file import checked_content
from surgsim_env.scene.model import CARTESIAN, PAIRS, TACTILE_PROBE, LibraryMaterial, Scene, Taxels

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
    """Folder with `organs/`, `instruments/` and `meshes/`; see `_shipped_folder`."""
    return _shipped_folder(PACKAGE_FOLDER / "assets", PACKAGE_FOLDER.parent / "scenes")


def agents_folder() -> Path:
    """Folder with `policies/` and `results/` of agents; see `_shipped_folder`."""
    return _shipped_folder(PACKAGE_FOLDER / "assets" / "agents", PACKAGE_FOLDER.parent / "agents")


def _shipped_folder(packed: Path, checkout: Path) -> Path:
    """Folder of shipped data: `packed` inside the package in a wheel, else `checkout` next to the package.

    No other place is searched: an editable install also leaves a copy in site-packages, which goes stale.
    """
    return packed if packed.is_dir() else checkout


def read_toml(path: Path, kind: str) -> dict[str, Any]:
    """Table of a TOML file; a ValueError names an unreadable file, or the line of invalid TOML."""
    checked_content(path)
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{kind} file {path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"{kind} file {path} is not valid TOML: {error}") from None


def fill(kind: type[Table], table: dict[str, Any], source: str) -> Table:
    """Fill a dataclass from a table of a TOML file, checking all entries.

    Args:
        kind: the dataclass.
        table: its entries.
        source: owner of the table, for messages.

    Raises:
        ValueError: an unknown entry (suggests the nearest), a missing or a wrong one; the message begins with `source`.
    """
    lists = {hint: _listed for part in dataclasses_in(kind) for hint in _tuples_in(*get_type_hints(part).values())}
    hooks: dict[Any, Any] = {float: _real, **lists}
    try:
        return dacite.from_dict(kind, table, dacite.Config(strict=True, cast=[tuple], type_hooks=hooks))
    except dacite.UnexpectedDataError as error:
        unknown = sorted(map(str, error.keys))[0]
        known = sorted({entry.name for part in dataclasses_in(kind) for entry in fields(part)})
        raise ValueError(f"{source}: entry {unknown!r} is unknown there{nearest(unknown, known)}") from None
    except (dacite.DaciteError, OrganError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{source}: {error}") from None


def dataclasses_in(kind: Any) -> Iterator[Any]:
    """A dataclass and the dataclasses of its fields, at any depth; for another type, those of its arguments."""
    if is_dataclass(kind):
        yield kind
        for hint in get_type_hints(kind).values():
            yield from dataclasses_in(hint)
    for part in get_args(kind):
        yield from dataclasses_in(part)


def _tuples_in(*hints: Any) -> Iterator[Any]:
    """Tuple types among type hints and their arguments."""
    for hint in hints:
        if get_origin(hint) is tuple:
            yield hint
        yield from _tuples_in(*get_args(hint))


def nearest(name: str, known: list[str]) -> str:
    """Hint at the most similar known name; empty if none is similar."""
    folded = {other.casefold(): other for other in known}
    matches = get_close_matches(name.casefold(), folded, n=1)
    return f"; did you mean {folded[matches[0]]!r}?" if matches else ""


def require_known(kind: str, name: object, known: Iterable[str]) -> None:
    """Check a name.

    Raises:
        ValueError: an unknown name (lists the known ones, suggests the nearest).
    """
    if name not in (names := list(known)):
        raise ValueError(f"{kind} {name!r} is unknown; the {kind}s are {', '.join(names)}{nearest(str(name), names)}")


def _listed(value: Any) -> Any:
    # tuple() would take a table's keys, or a text's letters.
    if not isinstance(value, list | tuple):
        raise _EntryError(f"{value!r} is not a list")
    return value


def _real(value: Any) -> Any:
    """Convert an integer to a float: TOML has both."""
    return float(value) if isinstance(value, int) else value


def file_names(folder: str) -> list[str]:
    """Stems of the TOML files in a folder of `scenes_folder`."""
    return sorted(path.stem for path in (scenes_folder() / folder).glob("*.toml"))


def list_scenes() -> list[str]:
    """Names of the shipped scenes."""
    return file_names("organs")


def list_arms() -> list[str]:
    """Names of the shipped arms."""
    return file_names("instruments")


def make_scene(name: str | Path) -> Scene:
    """Read a scene by its name (see `list_scenes`) or its file's path.

    Raises:
        ValueError: an unknown name (lists the known ones, suggests the nearest) or a file that breaks the format.
    """
    name = str(name)
    if name.endswith(".toml"):
        return load_scene(Path(name))
    require_known("scene", name, list_scenes())
    return load_scene(scenes_folder() / "organs" / f"{name}.toml")


def with_instrument(scene: Scene, instrument: str | None) -> Scene:
    """Scene with another instrument: a Cartesian one, an arm, its path, a pair of arms; None: its own.

    Raises:
        ValueError: an unknown name (lists the known ones, suggests the nearest).
    """
    if instrument is None:
        return scene
    known = [*CARTESIAN, TACTILE_PROBE, *list_arms(), *PAIRS]
    if Path(instrument).suffix != ".toml" and instrument not in known and pair_names(str(instrument)) is None:
        raise ValueError(
            f"instrument {str(instrument)!r} is unknown{nearest(str(instrument), known)}; the instruments are "
            f"{', '.join(known)}, the path of an arm's TOML file, or two arms as LEFT+RIGHT"
        )
    if instrument == TACTILE_PROBE:
        taxels = scene.instrument.taxels or Taxels()
        return replace(scene, instrument=replace(scene.instrument, model="probe.xml", taxels=taxels))
    model = f"{instrument}.xml" if instrument in CARTESIAN else str(instrument)
    return _with_taxels(replace(scene, instrument=replace(scene.instrument, model=model, taxels=None)))


def _with_taxels(scene: Scene) -> Scene:
    """Scene with the taxels of its arm's file; another instrument keeps its own."""
    name = scene.instrument.model
    beside = scene.folder / name
    path = beside if beside.is_file() else Path(name)
    if name in list_arms():
        path = scenes_folder() / "instruments" / f"{name}.toml"
    if path.suffix != ".toml" or not path.is_file():
        return scene
    entries = read_toml(path, "arm").get("taxels")
    taxels = fill(Taxels, entries, f"arm {path.stem!r}: taxels") if isinstance(entries, dict) else None
    return replace(scene, instrument=replace(scene.instrument, taxels=taxels))


def pair_names(model: str) -> tuple[str, str] | None:
    """Left and right arm of a pair: a name in PAIRS, or two arms joined by "+"; None for any other instrument."""
    known = list_arms()
    for place in (place for place, letter in enumerate(model) if letter == "+"):
        left, right = model[:place], model[place + 1 :]
        if all(name in known or Path(name).suffix == ".toml" for name in (left, right)):
            return left, right
    return PAIRS.get(model)


def load_scene(path: Path) -> Scene:
    """Read a scene file; a ValueError names the file, the entry and its fault."""
    return scene_from_table(read_toml(path, "scene"), name=path.stem, folder=path.parent)


def scene_from_table(table: dict[str, Any], *, name: str, folder: Path) -> Scene:
    """Scene from the table of a scene file; paths in it are relative to `folder`.

    The entries of a table `material` with a `name` replace those of that library material; with a table `family` with a
    `template`, the file's entries replace those of the template's file.
    """
    table = _with_template(table, f"scene {name!r}", folder)
    table = _with_library_materials(table, f"scene {name!r}", folder)
    return _with_taxels(fill(Scene, {**table, "name": name, "folder": folder}, f"scene {name!r}"))


def _with_template(table: dict[str, Any], source: str, folder: Path) -> dict[str, Any]:
    """Table of a scene file over the table of its family's template, if there is one."""
    family = table.get("family")
    if not isinstance(family, dict) or "template" not in family:
        return table
    file = family["template"]
    template = read_toml(folder / file, "scene")
    if "family" in template:
        raise ValueError(f"{source}: family.template {file!r} has a family of its own; name the scene of one organ")
    own = {name: value for name, value in family.items() if name != "template"}
    return _laid_over(template, {**table, "family": own})


def list_materials() -> list[str]:
    """Names of the library's materials."""
    return file_names("materials")


def make_material(name: str | Path) -> LibraryMaterial:
    """Read a material, with its source, by its name (see `list_materials`) or its file's path.

    Raises:
        ValueError: an unknown name (lists the known ones, suggests the nearest) or a file that breaks the format.
    """
    path, table = _material_table(name, Path())
    return fill(LibraryMaterial, {**table, "name": path.stem}, f"material {path.stem!r}")


def _material_table(name: Any, folder: Path) -> tuple[Path, dict[str, Any]]:
    """Path and contents of a material's file."""
    if str(name).endswith(".toml"):
        path = folder / name
    else:
        require_known("material", name, list_materials())
        path = scenes_folder() / "materials" / f"{name}.toml"
    return path, read_toml(path, "material")


def _with_library_materials(table: dict[str, Any], source: str, folder: Path) -> dict[str, Any]:
    """Table of a scene file with the library's values in place of the names of its materials."""
    table = dict(table)
    if "material" in table:
        table["material"] = _with_library_material(table["material"], f"{source}: material", folder)
    if isinstance(regions := table.get("regions"), list | tuple):
        table["regions"] = [
            {
                **region,
                "material": _with_library_material(region["material"], f"{source}: regions[{n}].material", folder),
            }
            if isinstance(region, dict) and "material" in region
            else region
            for n, region in enumerate(regions)
        ]
    return table


def _with_library_material(entries: Any, source: str, folder: Path) -> Any:
    """Entries of a table `material`, over those of the library if it has a `name`."""
    if not isinstance(entries, dict) or "name" not in entries:
        return entries
    try:
        _, table = _material_table(entries["name"], folder)
    except ValueError as error:
        raise ValueError(f"{source}.name: {error}") from None
    return _laid_over(table["material"], {key: value for key, value in entries.items() if key != "name"})


def _laid_over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Tables merged at all depths, the entries of `above` on top."""
    merged = {**below, **above}
    for key, value in above.items():
        if isinstance(value, dict) and isinstance(below.get(key), dict):
            merged[key] = _laid_over(below[key], value)
    return merged


def make_retract_scene(name: str | Path) -> Scene:
    """Read a retraction scene by a name or path: the scene itself, or its retraction scene of the same organ.

    Raises:
        ValueError: as in `make_scene`, or the scene gives a reason against retracting its organ.
    """
    scene = make_scene(name)
    if scene.retract is not None or (scene.retract_scene is None and scene.retract_refusal is None):
        return scene
    if scene.retract_scene is None:
        raise ValueError(f"scene {scene.name!r} cannot be retracted: {scene.retract_refusal}")
    return load_scene(scene.folder / scene.retract_scene)
