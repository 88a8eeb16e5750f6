"""`surgsim palpate`: find or make the scene, palpate it, write the results."""

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from surgsim_env.cli.values import (
    MaybeCount,
    MaybeNumber,
    MaybePath,
    MaybeText,
    command_text,
    numbers_of,
    unit_of,
    vector_of,
)
from surgsim_env.palpation.figures import write_stiffness_map
from surgsim_env.palpation.job import (
    CSV_NAME,
    MODEL_MODULUS_ERROR,
    PICTURE_NAME,
    SUMMARY_NAME,
    plan_sites,
    print_report,
    run_palpation,
    write_csv,
    write_summary,
)
from surgsim_env.palpation.surface_scene import SurfaceOptions, load_stable_anatomy, surface_scene, with_options
from surgsim_env.reports.output_folder import OutputFolder, output_folder
from surgsim_env.reports.step_progress import StepProgress
from surgsim_env.scene.anatomy import Anatomy, load_anatomy
from surgsim_env.scene.load import load_scene, make_scene
from surgsim_env.scene.model import Ball, Scene, Vector


@dataclass(frozen=True)
class Palpate:
    """Press an organ site by site, map its stiffness, and report where lesions were felt.

    Lengths are in metres, forces in newtons. Writes palpation.csv, stiffness_map.png and summary.json.
    """

    scene: MaybeText = None
    """A shipped scene (see `surgsim scenes`); liver if neither --organ nor --surface is given."""
    organ: MaybePath = None
    """Your own scene file (TOML), instead of --scene."""
    surface: MaybePath = None
    """A closed surface (STL, OBJ, PLY), instead of --scene; tissue and touch are those of the scene liver."""
    segmentation: MaybePath = None
    """A label image of a scan (NIfTI, NRRD, DICOM), instead of --scene; makes the organ like `surgsim organ`."""
    labels: MaybeText = None
    """NAME=LABEL,...: the labels of --segmentation, the organ first, such as liver=1,lesion=2."""
    length_unit: MaybeText = None
    """Unit of --surface: m, cm, mm, or metres per unit as a number."""
    cell_size: MaybeNumber = None
    """Cell size of the lattice that fills --surface or --segmentation [m]; default: in proportion to the organ, and so
    are tip, press depth and spacing (docs/patient.md)."""
    lesion: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """x,y,z,radius,ratio: centre and radius [m], ratio of its modulus to the healthy one; repeatable; replaces the
    scene's lesions."""
    lesion_below: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """SITE,DEPTH,RADIUS,RATIO: a lesion below a site of the raster, by its number in palpation.csv; depth of its centre
    and radius [m], ratio as in --lesion; repeatable, with or without --lesion."""
    anchors: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """x,y,z,radius: a ball [m]; the surface inside it is fixed. Default: fat over the side away from the probe."""
    approach: MaybeText = None
    """x,y,z: direction of the probe. Default: the scene's; 0,0,-1 for --surface (from the head where z is up)."""
    around: MaybeText = None
    """x,y,z,radius: press only the sites inside this ball [m]; default: the whole palpable face."""
    press_depth: MaybeNumber = None
    """Depth of a press [m]; default: the scene's."""
    tip_radius: MaybeNumber = None
    """Radius of the ball tip [m]; default: the scene's."""
    spacing: MaybeNumber = None
    """Distance between sites [m]; default: the scene's."""
    youngs_modulus: MaybeNumber = None
    """Young's modulus of the healthy tissue [Pa]; default: the scene's."""
    out: MaybePath = None
    """Folder for the results; default: the next free runs/palpate-SCENE-NUMBER."""
    seed: int = 0
    """Seed of the sensor's noise and of the pre-operative model's errors."""
    workers: MaybeCount = None
    """Number of threads; default: one for each core."""

    @property
    def options(self) -> SurfaceOptions:
        """Options that replace values of the scene or the file."""
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
    def command_line(self) -> str:
        """The command line with these options."""
        return command_text(["surgsim", "palpate"], vars(self))

    def run(self, console: Console) -> int:
        """Palpate, write palpation.csv, stiffness_map.png and summary.json, and print the lesions found.

        Raises:
            ValueError: options that do not go together, impossible values, files that cannot become an organ.
        """
        _check(self)
        # Checked before an organ is made, which takes a minute.
        around, asked, below = _around(self), _asked_lesions(self), _asked_below(self)
        # Without a cell size, an organ is made in proportion to its size, as `surgsim organ` makes it.
        file = self.segmentation or (self.surface if self.cell_size is None else None)
        if file is None:
            scene = _scene(self, console)
            default = Path("runs") / f"palpate-{scene.name}"
        else:
            scene, default = None, Path("runs") / f"palpate-{_stem(file)}"
        names = (CSV_NAME, SUMMARY_NAME, PICTURE_NAME)
        with output_folder(self.out or default, names, numbered=self.out is None) as files:
            if file is not None:
                scene = _patient_scene(self, file, files, console)
            assert scene is not None
            with StepProgress(console) as progress, progress.step("preparing the organ"):
                anatomy = load_anatomy(scene)
                lesions = anatomy.demonstration_lesions()
                if asked or below:
                    places = [*asked, *(_below_site(anatomy, *one) for one in below)]
                    lesions = [anatomy.lesion_at(*one, f"lesion {n}") for n, one in enumerate(places, start=1)]
                    for lesion in lesions:
                        anatomy.check_inside(lesion)
                anatomy = load_stable_anatomy(scene, lesions, modulus_factor_largest=1.0 + MODEL_MODULUS_ERROR)
            found = run_palpation(
                anatomy, lesions=lesions, around=around, seed=self.seed, workers=self.workers, console=console
            )
            with StepProgress(console) as progress, progress.step("drawing the map"):
                write_csv(found, files / CSV_NAME)
                write_summary(found, files / SUMMARY_NAME, vars(self))
                write_stiffness_map(found, files / PICTURE_NAME)
        print_report(found, console)
        console.print(f"written: {files.path}/{{{','.join(names)}}}", highlight=False, soft_wrap=True)
        return 0


def _check(command: Palpate) -> None:
    sources = (command.scene, command.organ, command.surface, command.segmentation)
    if sum(source is not None for source in sources) > 1:
        raise ValueError("give only one of --scene, --organ, --surface and --segmentation")
    if command.labels is not None and command.segmentation is None:
        raise ValueError("--labels goes with --segmentation: it names the labels of an image")
    if command.segmentation is not None and command.length_unit is not None:
        raise ValueError("--length-unit goes with --surface; an image's header states its own")
    if command.surface is None and command.segmentation is None:
        for option in ("anchors", "cell_size", "length_unit"):
            if getattr(command, option):
                name = option.replace("_", "-")
                raise ValueError(f"--{name} goes with --surface; a scene states its own mesh and anchors")
    if command.surface is not None and command.length_unit is None:
        raise ValueError('--surface needs --length-unit: "m", "cm", "mm" or metres per unit; its format states none')
    if command.seed < 0:
        raise ValueError(f"--seed is {command.seed}; it must be a whole number of at least 0")


def _around(command: Palpate) -> Ball | None:
    if command.around is None:
        return None
    x, y, z, radius = numbers_of("--around", command.around, "x,y,z,radius")
    if not 0.0 < radius < float("inf"):
        raise ValueError(f"--around {command.around}: the radius is {radius:g} m; it must be finite and above 0")
    return Ball((x, y, z), radius)


def _asked_lesions(command: Palpate) -> list[tuple[Vector, float, float]]:
    """Centre [m], radius [m] and modulus ratio of each --lesion."""
    asked = []
    for text in command.lesion:
        x, y, z, radius, ratio = numbers_of("--lesion", text, "x,y,z,radius,ratio")
        if not ratio > 0.0:
            raise ValueError(f"--lesion {text}: the modulus ratio is {ratio:g}; it must be above 0")
        asked.append(((x, y, z), radius, ratio))
    return asked


def _asked_below(command: Palpate) -> list[tuple[int, float, float, float]]:
    """Site, depth of the centre [m], radius [m] and modulus ratio of each --lesion-below."""
    asked = []
    for text in command.lesion_below:
        site, depth, radius, ratio = numbers_of("--lesion-below", text, "SITE,DEPTH,RADIUS,RATIO")
        if site != int(site) or site < 0:
            raise ValueError(f"--lesion-below {text}: the site is {site:g}; it must be a site's number, from 0")
        if not ratio > 0.0:
            raise ValueError(f"--lesion-below {text}: the modulus ratio is {ratio:g}; it must be above 0")
        if not depth > radius > 0.0:
            raise ValueError(
                f"--lesion-below {text}: the centre is {depth * 1e3:g} mm deep, the radius {radius * 1e3:g} mm; the "
                "rule is depth > radius > 0, or it sticks out of the organ"
            )
        asked.append((int(site), depth, radius, ratio))
    return asked


def _below_site(anatomy: Anatomy, site: int, depth: float, radius: float, ratio: float) -> tuple[Vector, float, float]:
    """Centre [m], radius [m] and modulus ratio of a lesion below a site."""
    sites, normals, _ = plan_sites(anatomy)
    if site >= len(sites):
        raise ValueError(f"--lesion-below {site}: there are {len(sites)} sites, from 0 to {len(sites) - 1}")
    x, y, z = (sites[site] - depth * normals[site]).tolist()
    return (x, y, z), radius, ratio


def _scene(command: Palpate, console: Console) -> Scene:
    """The scene of a file or a name, or of a surface with a cell size."""
    if command.surface is not None:
        return _surface_scene(command, command.surface, console)
    scene = load_scene(command.organ) if command.organ else make_scene(command.scene or "liver")
    return with_options(scene, command.options)


def _patient_scene(command: Palpate, file: Path, files: OutputFolder, console: Console) -> Scene:
    """Make an organ from a file, write it among the results, and read its scene."""
    from surgsim_env.patient.make_patient import check_targets, make_patient, print_patient, write_organ

    out = files.path / f"{_stem(file)}.vtu"
    check_targets(out)
    with StepProgress(console) as progress:
        found = make_patient(
            (file,),
            out,
            labels=command.labels,
            length_unit=unit_of(command.length_unit),
            cell_size=command.cell_size,
            options=command.options,
            progress=progress,
        )
        print_patient(found, console)
        with progress.step("drawing the report"):
            write_organ(found, files, out.name, command.command_line)
    return load_scene(files / out.with_suffix(".toml").name)


def _surface_scene(command: Palpate, file: Path, console: Console) -> Scene:
    unit, cell_size = unit_of(command.length_unit), command.cell_size
    assert unit is not None and cell_size is not None
    scene = surface_scene(file, length_unit=unit, cell_size=cell_size, options=command.options)
    x, y, z = scene.instrument.approach
    held = "the anchors given" if command.anchors else "fat on the side away from the probe"
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
