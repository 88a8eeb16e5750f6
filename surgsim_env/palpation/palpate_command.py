"""What `surgsim palpate` does: find or make the scene, palpate it, write what was found."""

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from surgsim_env.anatomy import load_anatomy
from surgsim_env.command_values import command_line, numbers_of, unit_of, vector_of
from surgsim_env.out_folder import writable_folder
from surgsim_env.palpation.surface_scene import SurfaceOptions, load_stable_anatomy, surface_scene, with_options
from surgsim_env.scenes import Ball, Scene, Vector, load_scene, make_scene


@dataclass(frozen=True)
class Request:
    """The options of `surgsim palpate`, as the command line explains them."""

    scene: str | None
    organ: Path | None
    surface: Path | None
    segmentation: Path | None
    labels: str | None
    length_unit: str | None
    cell_size: float | None
    lesion: tuple[str, ...]
    anchors: tuple[str, ...]
    approach: str | None
    around: str | None
    press_depth: float | None
    tip_radius: float | None
    spacing: float | None
    youngs_modulus: float | None
    out: Path | None
    seed: int
    workers: int | None

    @property
    def options(self) -> SurfaceOptions:
        """What is said beyond the scene or the file."""
        balls = (numbers_of("--anchors", text, "x,y,z,radius") for text in self.anchors)
        return SurfaceOptions(
            approach=vector_of("--approach", self.approach),
            anchors=tuple((x, y, z, radius) for x, y, z, radius in balls),
            press_depth=self.press_depth,
            tip_radius=self.tip_radius,
            spacing=self.spacing,
            youngs_modulus=self.youngs_modulus,
        )

    @property
    def command(self) -> str:
        """The command line that says the same."""
        return command_line(["surgsim", "palpate"], vars(self))

    @property
    def makes_organ(self) -> bool:
        """Whether an organ is made from a file in proportion to its size, as `surgsim organ` makes it."""
        return self.segmentation is not None or (self.surface is not None and self.cell_size is None)


def palpate(request: Request, console: Console) -> None:
    """Palpate, write palpation.csv, stiffness_map.png and summary.json, and print what was found.

    Raises:
        ValueError: options that do not go together, impossible values, files that cannot become an organ.
    """
    from surgsim_env.palpation.figures import write_stiffness_map
    from surgsim_env.palpation.job import MODEL_MODULUS_ERROR, run_palpation
    from surgsim_env.palpation.report import (
        CSV_NAME,
        PICTURE_NAME,
        SUMMARY_NAME,
        print_report,
        write_csv,
        write_summary,
    )

    _check(request)
    # Before an organ is made, which takes a minute.
    around, asked = _around(request), _asked_lesions(request)
    names = (CSV_NAME, SUMMARY_NAME, PICTURE_NAME)
    scene, folder = _scene(request, names, console)
    anatomy = load_anatomy(scene)
    lesions = anatomy.demonstration_lesions()
    if asked:
        lesions = [anatomy.lesion_at(*one, f"lesion {number}") for number, one in enumerate(asked, start=1)]
    anatomy = load_stable_anatomy(scene, lesions, modulus_factor_largest=1.0 + MODEL_MODULUS_ERROR)
    # Before the work: a place that cannot be written is better known now than after it.
    folder = folder or writable_folder(request.out or _free_folder(scene.name), names)
    found = run_palpation(
        anatomy, lesions=lesions, around=around, seed=request.seed, workers=request.workers, console=console
    )
    write_csv(found, folder / CSV_NAME)
    write_summary(found, folder / SUMMARY_NAME, vars(request))
    write_stiffness_map(found, folder / PICTURE_NAME)
    print_report(found, console)
    console.print(f"written: {folder}/{{{CSV_NAME},{SUMMARY_NAME},{PICTURE_NAME}}}", highlight=False, soft_wrap=True)


def _check(request: Request) -> None:
    sources = (request.scene, request.organ, request.surface, request.segmentation)
    if sum(source is not None for source in sources) > 1:
        raise ValueError("give only one of --scene, --organ, --surface and --segmentation")
    if request.labels is not None and request.segmentation is None:
        raise ValueError("--labels goes with --segmentation: it says what the labels of an image are")
    if request.segmentation is not None and request.length_unit is not None:
        raise ValueError("--length-unit goes with --surface; an image's header states its own")
    if request.surface is None and request.segmentation is None:
        for option in ("anchors", "cell_size", "length_unit"):
            if getattr(request, option):
                name = option.replace("_", "-")
                raise ValueError(f"--{name} goes with --surface; a scene states its own mesh and anchors")
    if request.surface is not None and request.length_unit is None:
        raise ValueError('--surface needs --length-unit: "m", "cm", "mm" or metres per unit; its format states none')
    if request.seed < 0:
        raise ValueError(f"--seed is {request.seed}; it must be a whole number of at least 0")


def _around(request: Request) -> Ball | None:
    if request.around is None:
        return None
    x, y, z, radius = numbers_of("--around", request.around, "x,y,z,radius")
    if not 0.0 < radius < float("inf"):
        raise ValueError(f"--around {request.around}: the radius is {radius:g} m; it must be finite and above 0")
    return Ball((x, y, z), radius)


def _asked_lesions(request: Request) -> list[tuple[Vector, float, float]]:
    """Centre [m], radius [m] and modulus ratio of each --lesion."""
    asked = []
    for text in request.lesion:
        x, y, z, radius, ratio = numbers_of("--lesion", text, "x,y,z,radius,ratio")
        if not ratio > 0.0:
            raise ValueError(f"--lesion {text}: the modulus ratio is {ratio:g}; it must be above 0")
        asked.append(((x, y, z), radius, ratio))
    return asked


def _scene(request: Request, names: tuple[str, ...], console: Console) -> tuple[Scene, Path | None]:
    """The scene, and the folder where the organ was written if one was made."""
    if request.makes_organ:
        from surgsim_env.patient.command import palpable_patient

        file = request.segmentation or request.surface
        assert file is not None
        folder = writable_folder(request.out or _free_folder(_stem(file)), names)
        return palpable_patient(request, folder, console), folder
    if request.surface is None:
        scene = load_scene(request.organ) if request.organ else make_scene(request.scene or "liver")
        return with_options(scene, request.options), None
    return _surface_scene(request, request.surface, console), None


def _surface_scene(request: Request, file: Path, console: Console) -> Scene:
    unit, cell_size = unit_of(request.length_unit), request.cell_size
    assert unit is not None and cell_size is not None
    scene = surface_scene(file, length_unit=unit, cell_size=cell_size, options=request.options)
    x, y, z = scene.instrument.approach
    held = "the anchors given" if request.anchors else "its bed, the deepest 15 % along the approach"
    material, depth, tip = scene.material, scene.palpation.press_depth, scene.instrument.tip_radius
    console.print(
        f"{file.name}: pressed along {x:.3g}, {y:.3g}, {z:.3g} of the file's axes (--approach), "
        f"held by {held}; E {material.youngs_modulus:g} Pa, nu {material.poisson_ratio:g}, tip {tip * 1e3:g} mm, "
        f"depth {depth * 1e3:g} mm, capsule and damping as in the scene liver",
        highlight=False,
    )
    return scene


def _stem(file: Path) -> str:
    return file.name.split(".")[0]


def _free_folder(scene: str) -> Path:
    number = 1
    while (folder := Path("runs") / f"palpate-{scene}-{number}").exists():
        number += 1
    return folder
