"""`surgsim palpate`: palpate a scene, and write the results."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from surgsim_apps.cli.values import (
    MaybeLength,
    MaybePath,
    MaybeText,
    SceneName,
    command_text,
    numbers_of,
    shown_path,
    vector_of,
)
from surgsim_apps.palpate.field_press import FIELDS_NAME, SERIES_NAME, record_press
from surgsim_apps.palpate.figures import write_organ_picture, write_stiffness_map
from surgsim_apps.palpate.palpation import MODEL_MODULUS_ERROR, load_stable_anatomy, run_palpation
from surgsim_apps.palpate.report import print_report, write_report
from surgsim_apps.palpate.results import (
    CSV_NAME,
    ORGAN_NAME,
    PICTURE_NAME,
    REPORT_NAME,
    SUMMARY_NAME,
    write_csv,
    write_summary,
)
from surgsim_apps.palpate.scene_options import SceneOptions, check_lengths, with_options
from surgsim_apps.palpate.sites import plan_sites
from surgsim_apps.reports.output_folder import output_folder
from surgsim_env.scene import Anatomy, Ball, Vector, load_anatomy, make_scene
from surgsim_env.step_progress import StepProgress


@dataclass(frozen=True)
class Palpate:
    """Press an organ site by site, map its stiffness, and report the felt lesions.

    Writes report.html (self-contained), tables and pictures. A length is 5mm, 0.5cm or
    0.005 (metres).
    """

    scene: SceneName = "liver"
    """A shipped scene (see `surgsim scenes`) or a scene file of your own (TOML)."""
    lesion: tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="X,Y,Z,RADIUS,RATIO")]] = ()
    """Lesion in place of the scene's: centre, radius, and ratio of its modulus to the healthy one."""
    lesion_below: tyro.conf.UseAppendAction[
        Annotated[tuple[str, ...], tyro.conf.arg(metavar="SITE,DEPTH,RADIUS,RATIO")]
    ] = ()
    """Lesion below a site, by its number in palpation.csv, likewise; the depth is that of its centre."""
    approach: MaybeText = None
    """x,y,z: direction of the probe. Default: the scene's."""
    around: MaybeText = None
    """x,y,z,radius: press only the sites inside this ball; default: the whole palpable face."""
    press_depth: MaybeLength = None
    """Depth of a press; default: the scene's."""
    spacing: MaybeLength = None
    """Distance between sites; default: the scene's."""
    fields: bool = False
    """Record the fields (pressure, stress, stretch, energy) of a press over the first lesion: a
    series for ParaView in fields/, and a picture in the report."""
    out: MaybePath = None
    """Folder for the results; default: the next free runs/palpate-SCENE-NUMBER."""
    seed: int = 0
    """Seed of the sensor's noise and of the pre-operative model's errors."""

    @property
    def options(self) -> SceneOptions:
        """Replacements of values of the scene."""
        return SceneOptions(
            approach=vector_of("--approach", self.approach),
            press_depth=self.press_depth,
            spacing=self.spacing,
        )

    @property
    def command_line(self) -> str:
        """The command for the same report, without --out."""
        options = {name: value for name, value in vars(self).items() if name != "out"}
        return command_text(["surgsim", "palpate"], {**options, "scene": shown_path(self.scene)})

    def run(self, console: Console) -> int:
        """Palpate, write report, tables and pictures, and print the felt lesions.

        Raises:
            ValueError: conflicting options, impossible values, an unreadable scene file.
        """
        _check(self)
        around, lesion_options, below = _around(self), _asked_lesions(self), _asked_below(self)
        scene = with_options(make_scene(self.scene), self.options)
        names = (REPORT_NAME, CSV_NAME, SUMMARY_NAME, PICTURE_NAME, ORGAN_NAME, FIELDS_NAME, SERIES_NAME)
        default = Path("runs") / f"palpate-{scene.name}"
        with output_folder(self.out or default, names, numbered=self.out is None) as files:
            with StepProgress(console) as progress:
                with progress.step("preparing the organ"):
                    anatomy = load_anatomy(scene)
                    check_lengths(anatomy, around)
                    lesions = anatomy.demonstration_lesions()
                    if lesion_options or below:
                        places = [*lesion_options, *(_below_site(anatomy, *lesion) for lesion in below)]
                        lesions = [anatomy.lesion_at(*place, f"lesion {n}") for n, place in enumerate(places, start=1)]
                        for lesion in lesions:
                            anatomy.check_inside(lesion)
                    anatomy = load_stable_anatomy(scene, lesions, modulus_factor_largest=1.0 + MODEL_MODULUS_ERROR)
                palpation = run_palpation(anatomy, lesions=lesions, around=around, seed=self.seed, progress=progress)
                if self.fields:
                    record_press(palpation, files / SERIES_NAME, files / FIELDS_NAME, progress)
                with progress.step("drawing the maps"):
                    write_csv(palpation, files / CSV_NAME)
                    write_summary(palpation, files / SUMMARY_NAME, vars(self))
                    write_stiffness_map(palpation, files / PICTURE_NAME)
                    write_organ_picture(palpation, files / ORGAN_NAME)
                    pictures = {
                        "maps": files / PICTURE_NAME,
                        "organ": files / ORGAN_NAME,
                        "fields": files / FIELDS_NAME,
                    }
                    write_report(palpation, files / REPORT_NAME, **pictures, command=self.command_line)
        print_report(palpation, console)
        written = [name for name in names if (files.path / name).exists()]
        console.print(f"written: {files.path}/{{{','.join(written)}}}", highlight=False, soft_wrap=True)
        return 0


def _check(command: Palpate) -> None:
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
    lesions = []
    for text in command.lesion:
        x, y, z, radius, ratio = numbers_of("--lesion", text, "x,y,z,radius,ratio")
        if not ratio > 0.0:
            raise ValueError(f"--lesion {text}: the modulus ratio is {ratio:g}; it must be above 0")
        lesions.append(((x, y, z), radius, ratio))
    return lesions


def _asked_below(command: Palpate) -> list[tuple[int, float, float, float]]:
    """Site, depth of the centre [m], radius [m] and modulus ratio of each --lesion-below."""
    lesions = []
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
        lesions.append((int(site), depth, radius, ratio))
    return lesions


def _below_site(anatomy: Anatomy, site: int, depth: float, radius: float, ratio: float) -> tuple[Vector, float, float]:
    """Centre [m], radius [m] and modulus ratio of a lesion below a site."""
    sites, normals, _ = plan_sites(anatomy)
    if site >= len(sites):
        raise ValueError(f"--lesion-below {site:g}: there are {len(sites)} sites, from 0 to {len(sites) - 1}")
    x, y, z = (sites[site] - depth * normals[site]).tolist()
    return (x, y, z), radius, ratio
