"""`surgsim identify`: a material from recorded presses on tissue."""

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from surgsim_apps.cli.values import Length, MaybeLength, MaybePath, Paths, command_text
from surgsim_apps.palpate.scene_options import require_length
from surgsim_apps.reports.output_folder import output_folder


@dataclass(frozen=True)
class Identify:
    """Identify a material from recorded presses: modulus, stiffening, relaxation, offset and thickness, with intervals.

    Fits half of the sites and reports the error on the other half, beside the best linear tissue. Writes material.toml
    (for any scene file), sites.csv, curves.png, modulus_map.png and summary.json. See docs/identify.md.
    """

    recordings: tyro.conf.Positional[Paths]
    """CSV files with the columns site, depth_mm, normal_force_n and, if known, x_mm, y_mm, z_mm, time_s; one tissue."""
    ball_radius: Length = 0.00635
    """Radius of the pressing ball."""
    thickness: MaybeLength = None
    """Thickness of the tissue on its rigid bed; default: searched, with an interval."""
    poisson_ratio: float = 0.45
    """Poisson's ratio of the tissue; not identifiable by presses alone."""
    seed: int = 0
    """Seed for drawing the fitted half of the sites."""
    out: MaybePath = None
    """Folder for the results; default: the next free runs/identify-NAME-NUMBER."""

    @property
    def command_line(self) -> str:
        """The command line with these options."""
        options = {name: value for name, value in vars(self).items() if name != "recordings"}
        return command_text(["surgsim", "identify", *map(str, self.recordings)], options)

    def run(self, console: Console) -> int:
        """Identify, print the errors and unidentifiable parameters, write the results; returns 0.

        Raises:
            ValueError: no recording, an unreadable or unusable one, a value out of range.
            OSError: a read-only folder (checked before the work).
        """
        from surgsim_apps.identify import results
        from surgsim_apps.identify.identification import IdentifyOptions, identify
        from surgsim_apps.identify.recordings import read_recording

        if not self.recordings:
            raise ValueError("give a recording: a CSV file with the columns site, depth_mm, normal_force_n")
        require_length("--ball-radius", self.ball_radius, 0.1, "the largest ball")
        require_length("--thickness", self.thickness, 20.0 * self.ball_radius, "20 radii of the ball")
        options = IdentifyOptions(self.ball_radius, self.thickness, self.poisson_ratio, self.seed)
        sets = [read_recording(path) for path in self.recordings]
        default = Path("runs") / f"identify-{sets[0].name}"
        with output_folder(self.out or default, results.RESULT_NAMES, numbered=self.out is None) as files:
            identification = identify(sets, options, console=console)
            results.write_material(identification, files / results.MATERIAL_NAME, self.command_line)
            results.write_sites(identification, files / results.SITES_NAME)
            results.write_curves(identification, files / results.CURVES_NAME)
            has_map = results.write_map(identification, files / results.MAP_NAME)
            results.write_summary(identification, files / results.SUMMARY_NAME, self.command_line)
        results.print_result(identification, console)
        written = [name for name in results.RESULT_NAMES if has_map or name != results.MAP_NAME]
        console.print(f"written: {files.path}/{{{','.join(written)}}}", highlight=False, soft_wrap=True)
        return 0
