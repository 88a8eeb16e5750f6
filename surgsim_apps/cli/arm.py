"""`surgsim arm check`: a palpating arm from an MJCF or URDF file, with its TOML file and a picture."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro
from rich.console import Console

from surgsim_apps.cli.values import AnyPath, MaybeLength, MaybePath, MaybeText, vector_of
from surgsim_apps.palpate.scene_options import require_length
from surgsim_apps.reports.output_folder import output_folder
from surgsim_env.step_progress import StepProgress

if TYPE_CHECKING:
    from surgsim_env.instruments import Arm as ArmKinematics

# Least share of the places around home in reach of a useful arm's tip.
REACH_LEAST = 0.5
# Longest palpator [m].
TOOL_LONGEST = 1.0
# Comments on the entries of the written file.
COMMENTS = {
    "model": "MJCF or URDF file, relative to this file",
    "kind": '"palpator" or "grasper"',
    "joints": "driven joints, base to tip",
    "contact": "geoms that tissue feels: spheres and capsules",
    "links": "outer shapes, for clearances only",
    "dropped_meshes": "meshes of the URDF that are left out: put them beside it and take them out here",
    "description": "one line",
    "tip": "the controlled point",
    "tip.body": "link that carries it",
    "tip.offset": "[m] in that link's frame",
    "tip.direction": "out of the tip, in that link's frame",
    "tip.ball": "sphere whose radius a scene sets",
    "trocar": "where the shaft passes through the body wall; a scene's port is put there",
    "trocar.shaft_body": "link with the straight shaft",
    "trocar.shaft_point": "[m] a point of the shaft's axis, in that link's frame",
    "trocar.shaft_axis": "direction of the shaft to the tip, in that link's frame",
    "trocar.point": "[m] in the model's own frame",
    "trocar.into": "direction into the patient, in the model's own frame",
    "trocar.fixed": "true: the mechanism keeps the shaft there (remote centre); false: control does",
    "trocar.tolerance": "[m] largest distance of shaft and trocar",
    "control": "one number a joint, in the order of joints",
    "control.mode": '"position": the model\'s own position actuators; "servo": they are replaced by servos',
    "control.speed_limit": "[rad/s, m/s]",
    "control.stiffness": "[N m/rad, N/m] inertia at home times (2 pi 30 Hz)^2, and at least 5e4 N/m at the tip",
    "control.damping": "[N m s/rad, N s/m] critical",
    "control.effort": "[N m, N] largest torque or force",
    "control.armature": "[kg m^2, kg] rotor inertia, of the model or chosen for that stiffness",
    "home": "[rad, m] the shaft in the trocar, the tip past it",
    "limits": "[rad, m] of joints for which the model states none, or which joints that follow them narrow",
    "held": "[rad, m] other joints, fixed at these values",
    "shapes": "sphere or capsule that the model lacks",
    "shapes.body": "link that carries it",
    "shapes.start": "[m] one end of the axis, or the middle of a ball, in the link's frame",
    "shapes.end": "[m] the other end",
    "shapes.radius": "[m]",
    "inertias": "mass and inertia of a link in place of the URDF's, which are missing or not those of a body",
    "inertias.mass": "[kg]",
    "inertias.centre": "[m] centre of mass in the link's frame",
    "inertias.moments": "[kg m^2] about the axes of that frame, of a solid block",
}


@dataclass(frozen=True)
class Arm:
    """Make a palpating arm from an MJCF or URDF file: `surgsim arm check FILE`, or robot_descriptions:NAME.

    Finds the chain of joints, the tip, the shaft, a trocar and a home; finds meshes, replaces missing inertias, adds
    contact shapes. Writes NAME.toml, with a comment on every entry, and NAME.png. See docs/arms.md.
    """

    action: tyro.conf.Positional[Literal["check"]]
    """The action."""
    file: tyro.conf.Positional[AnyPath]
    """MJCF or URDF file of the arm, or robot_descriptions:NAME, a model of the package robot_descriptions."""
    tip: MaybeText = None
    """Link or site of the tip, or of the tool's mount; default: the end of the longest chain of joints."""
    trocar: MaybeText = None
    """Trocar x,y,z in the model's own frame, lengths; default: the remote centre, else chosen together with home."""
    tool: MaybeLength = None
    """Mount a straight palpator of this length, even beside a shaft; default: 400mm on arms without a shaft."""
    out: MaybePath = None
    """Folder for the results; default: that of the file, for robot_descriptions the current folder."""

    def run(self, console: Console) -> int:
        """Make the arm, print findings and choices, write its TOML file and a picture; 1 if it reaches little.

        Raises:
            ValueError: a file without an arm, or an impossible option.
        """
        from surgsim_apps.arms.find_arm import find_arm
        from surgsim_env.instruments import load_arm
        from surgsim_env.scene import as_toml, require_number

        if self.tool is not None:
            require_number("--tool", self.tool, 0.05, "m")
            require_length("--tool", self.tool, TOOL_LONGEST, "an instrument")
        scheme, _, stem = str(self.file).partition(":")
        if scheme == "robot_descriptions":
            file, folder = _public_model(stem, console), self.out or Path()
        else:
            file, folder, stem = self.file, self.out or self.file.parent, self.file.stem
        names = f"{stem}.toml", f"{stem}.png"
        if (folder / names[0]).exists():
            raise ValueError(f"{folder / names[0]} is there already: remove it, or give another --out")
        with StepProgress(console) as progress, progress.step("looking for a home"):
            arm_model = find_arm(
                file,
                tip=self.tip,
                trocar=vector_of("--trocar", self.trocar, are_lengths=True),
                tool_length=self.tool,
            )
        if scheme == "robot_descriptions":
            arm_model.chosen.append(f"the model stays in the cache of robot_descriptions: {file}")
        for sentence in arm_model.notes:
            console.print(f"found: {sentence}", highlight=False, soft_wrap=True)
        for sentence in arm_model.chosen:
            console.print(f"warning: {sentence}", highlight=False, soft_wrap=True, style="yellow")
        model = os.path.relpath(file.resolve(), folder.resolve())
        description = replace(arm_model.description, model=Path(model).as_posix())
        head = (
            f"Written by `surgsim arm check` from {file.name}; docs/arms.md explains every entry.",
            *(f"Found: {sentence}." for sentence in arm_model.notes),
            *(f"Chosen: {sentence}." for sentence in arm_model.chosen),
        )
        arm = load_arm(arm_model.description)
        with output_folder(folder, names) as files:
            (files / names[0]).write_text(as_toml(description, head=head, comments=COMMENTS), encoding="utf-8")
            drawn = _draw(arm, files / names[1], console)
        written = names if drawn else names[:1]
        console.print(f"written: {folder}/{{{','.join(written)}}}", highlight=False, soft_wrap=True)
        if arm_model.reach < REACH_LEAST:
            console.print(
                f"the tip reaches {arm_model.reach:.0%} of the places around home: name another --trocar or --tip",
                highlight=False,
                soft_wrap=True,
            )
            return 1
        console.print(
            f'try it: gymnasium.make("SurgSim/Palpate-v0", scene="phantom", instrument="{folder / names[0]}")',
            highlight=False,
            soft_wrap=True,
        )
        return 0


def _public_model(name: str, console: Console) -> Path:
    """Model file of the package robot_descriptions, downloaded and expanded by its own command.

    Raises:
        ValueError: no such package or name, a download that fails.
    """
    from surgsim_env.scene import nearest

    try:
        known = list(import_module("robot_descriptions").DESCRIPTIONS)
    except ImportError:
        raise ValueError("robot_descriptions is not installed: pip install robot_descriptions xacrodoc") from None
    if name not in known:
        raise ValueError(f"robot_descriptions has no model {name!r}{nearest(name, known)}")
    with StepProgress(console) as progress, progress.step(f"downloading {name}"):
        command = [sys.executable, "-m", "robot_descriptions", "pull", name]
        pulled = subprocess.run(command, capture_output=True, text=True, check=False)
    if pulled.returncode != 0:
        # The exception at the end of a traceback, without progress bars.
        ended = re.split(r"^(?=[\w.]+Error)", pulled.stderr, flags=re.MULTILINE)[-1]
        reason = " ".join(line for line in ended.splitlines() if "it/s" not in line)
        raise ValueError(f"robot_descriptions could not give {name}: {reason}")
    return Path(pulled.stdout.splitlines()[-1])


def _draw(arm: ArmKinematics, path: Path, console: Console) -> bool:
    """Write a picture of an arm at home; False, with a message, without OpenGL."""
    from matplotlib.image import imsave

    from surgsim_apps.arms.arm_picture import draw_arm
    from surgsim_env.rendering import NoGLError

    try:
        picture = draw_arm(arm, arm.home)
    except NoGLError as error:
        console.print(f"no picture: {error}", highlight=False, soft_wrap=True)
        return False
    imsave(path, picture, format="png")
    return True
