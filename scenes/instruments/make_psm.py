#!/usr/bin/env python3
"""Write `psm_palpator.xml`, `psm_grasper.xml`, `psm_retractor.xml`: a da Vinci-like arm with three tools of our own.

Kinematics, limits and efforts come from the one table in `surgsim_env/instruments/arm/psm.py`; masses, servos and
shapes are this project's own. The remote centre is held by an arc about it, on which a carriage with the insertion's
rail runs: a mechanism without idle joints. Parts are drawn where they stand in the port's frame with all joints at 0
(the shaft along z, the remote centre at 0, the patient below) and written in their links' frames.

    python scenes/instruments/make_psm.py [folder]
"""

import math
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

from surgsim_env.instruments.arm.psm import JAW_EFFORT, JAW_RANGE, PSM_LINKS, TIP_ROTATION, psm_frames

# Mass [kg], its centre at joints 0 in the port's frame [m], moments of inertia in the link's frame [kg m^2].
INERTIA = {
    "yaw": (0.8, (0.03, 0.20, 0.18), (0.02, 0.02, 0.02)),
    "pitch": (0.35, (0.05, 0.0, 0.30), (0.004, 0.004, 0.004)),
    "insertion": (0.25, (0.02, 0.0, 0.44), (0.0005, 0.0005, 0.0005)),
    "roll": (0.05, (0.0, 0.0, 0.22), (7e-4, 7e-4, 4e-6)),
    "wrist_pitch": (0.006, (0.0, 0.0, 0.011), (1e-6, 1e-6, 1e-6)),
    "wrist_yaw": (0.012, (0.0, 0.0, -0.006), (1e-6, 1e-6, 1e-6)),
    "finger": (0.003, (0.0, 0.0, 0.0), (3e-7, 3e-7, 3e-7)),
    "long_finger": (0.005, (0.0, 0.0, -0.024), (6e-7, 6e-7, 2e-7)),
}
# Reflected inertia of the motor [kg m^2 or kg], friction [N m s or N s/m], servo stiffness and damping. Chosen: natural
# frequencies of 13 to 30 Hz, about critically damped; 5 N at the tip move it by 0.4 to 1 mm.
DRIVE = {
    "yaw": (0.02, 0.1, 1200.0, 22.0),
    "pitch": (0.02, 0.1, 1200.0, 22.0),
    "insertion": (0.3, 2.0, 8000.0, 120.0),
    "roll": (1.5e-4, 2e-3, 6.0, 0.06),
    "wrist_pitch": (1.5e-4, 2e-3, 6.0, 0.06),
    "wrist_yaw": (1.5e-4, 2e-3, 6.0, 0.06),
    "finger": (2e-5, 2e-4, 1.5, 0.01),
    "long_finger": (2e-5, 2e-4, 1.5, 0.01),
}
SHAFT_RADIUS = 0.004  # an 8 mm instrument
TIP_LENGTH = {"palpator": 0.020, "grasper": 0.0102, "retractor": 0.026}  # beyond the wrist's yaw axis [m]
# The retractor's pads: half their width, thickness and length; half the gap at which they are parallel [m].
PAD_HALF, PARALLEL_GAP = (0.007, 0.0025, 0.008), 0.0035
# From 5.5 mm between the pads' middles to 23 mm [rad]; how hard a pad closes, at its middle [N].
PAD_RANGE = (-math.asin((PARALLEL_GAP - 0.00275) / TIP_LENGTH["retractor"]), math.radians(19.0))
PAD_FORCE = 0.4
# Serrated: this times the contact law's coefficient of friction.
PAD_ROUGHNESS = 5.0
# Keeps the jaw's middle where the wrist is: a load L across it shifts it by L l^2 / (4 k), 0.17 mm for 1 N, l being
# the pads' distance from their hinge [N m/rad, N m s/rad].
GEAR = (1.0, 2e-3)
LIGHT, METAL, DARK = "0.86 0.87 0.89 1", "0.72 0.74 0.78 1", "0.13 0.14 0.16 1"
BRIGHT, GREY, ACCENT = "0.90 0.91 0.94 1", "0.45 0.47 0.50 1", "0.10 0.42 0.60 1"
ARC_RADIUS, ARC_SIDE, RAIL_SIDE = 0.285, 0.078, 0.048  # arc about the remote centre; beside the shaft [m]

FRAMES = dict(zip([link.joint for link in PSM_LINKS], psm_frames(np.zeros(6)), strict=True))


def numbers(values) -> str:
    return " ".join(f"{value + 0.0:.16g}" for value in np.where(np.abs(values) < 1e-15, 0.0, values).ravel().tolist())


def quaternion(rotation) -> str:
    """(w, x, y, z) of a rotation matrix, an eigenvector (Bar-Itzhack 2000), to 15 digits: the same on any machine."""
    m = rotation
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    value = np.round(np.linalg.eigh(k)[1][:, -1], 15)
    # Both signs are the same rotation, and LAPACK's choice depends on the machine. Here the first of x, y, z that is
    # not 0 is positive.
    first = np.flatnonzero(value[1:])
    return numbers(value * np.sign(value[1:][first[0]] if len(first) else value[0]))


def local(link: str, point) -> str:
    """A point of the port's frame at joints 0, in a link's frame."""
    pose = FRAMES[link]
    return numbers(np.round(pose[:3, :3].T @ (np.asarray(point) - pose[:3, 3]), 12))


def capsule(link: str, name: str, start, end, radius: float, colour: str, group: int = 1, kind: str = "capsule") -> str:
    label = f'name="{name}" ' if name else ""
    return (
        f'<geom {label}type="{kind}" fromto="{local(link, start)} {local(link, end)}" size="{radius:g}" '
        f'group="{group}" rgba="{colour}"/>'
    )


def box(link: str, centre, half, colour: str) -> str:
    turned = np.abs(np.round(FRAMES[link][:3, :3].T @ np.asarray(half), 12))
    return f'<geom type="box" pos="{local(link, centre)}" size="{numbers(turned)}" group="1" rgba="{colour}"/>'


def ball(name: str, centre, radius: float, colour: str) -> str:
    place = local("wrist_yaw", centre)
    return f'<geom name="{name}" type="sphere" pos="{place}" size="{radius:g}" group="3" rgba="{colour}"/>'


def inertial(part: str, link: str) -> str:
    mass, centre, moments = INERTIA[part]
    return f'<inertial pos="{local(link, centre)}" mass="{mass:g}" diaginertia="{numbers(moments)}"/>'


def joint(name: str, part: str, lower: float, upper: float, effort: float, kind: str = "hinge", axis="0 0 1") -> str:
    armature, damping, _, _ = DRIVE[part]
    return (
        f'<joint name="{name}" type="{kind}" axis="{axis}" range="{lower:.16g} {upper:.16g}" '
        f'armature="{armature:g}" damping="{damping:g}" actuatorfrcrange="{-effort:g} {effort:g}"/>'
    )


def on_arc(angle: float) -> np.ndarray:
    """A point of the arc, by its angle [deg] from the shaft at pitch 0 towards +y."""
    turn = math.radians(angle)
    return np.array([ARC_SIDE, ARC_RADIUS * math.sin(turn), ARC_RADIUS * math.cos(turn)])


def yaw_parts() -> list[str]:
    angles = np.linspace(-62.0, 84.0, 10)
    arc = [
        capsule("yaw", f"arc_{k}", on_arc(a), on_arc(b), 0.011, LIGHT, 2) for k, (a, b) in enumerate(pairwise(angles))
    ]
    foot = on_arc(84.0)
    knee = np.array([ARC_SIDE, 0.33, 0.0])
    return [
        *arc,
        capsule("yaw", "", on_arc(-63.0), on_arc(-61.0), 0.0125, DARK),
        capsule("yaw", "strut", foot, knee, 0.016, LIGHT, 2),
        capsule("yaw", "bracket", knee, (0.0, 0.40, 0.0), 0.018, LIGHT, 2),
        capsule("yaw", "", (0.0, 0.385, 0.0), (0.0, 0.50, 0.0), 0.042, GREY, kind="cylinder"),
        capsule("yaw", "", (0.0, 0.378, 0.0), (0.0, 0.386, 0.0), 0.0425, ACCENT, kind="cylinder"),
        capsule("yaw", "", (0.0, 0.50, 0.0), (0.0, 0.52, 0.0), 0.034, DARK, kind="cylinder"),
    ]


def pitch_parts() -> list[str]:
    side, rail = ARC_SIDE, RAIL_SIDE
    return [
        box("pitch", (side, 0.0, ARC_RADIUS), (0.024, 0.042, 0.026), GREY),
        box("pitch", (side, 0.0, ARC_RADIUS), (0.0245, 0.030, 0.006), ACCENT),
        capsule("pitch", "rail", (rail, 0.0, 0.115), (rail, 0.0, 0.52), 0.010, METAL, 2),
        capsule("pitch", "", (rail, 0.0, 0.10), (rail, 0.0, 0.118), 0.013, DARK, kind="cylinder"),
        capsule("pitch", "", (rail, 0.0, 0.515), (rail, 0.0, 0.535), 0.013, DARK, kind="cylinder"),
        capsule("pitch", "", (rail, 0.0, 0.108), (0.0, 0.0, 0.075), 0.006, METAL),
        # The cannula: a funnel above the body wall and a thin tube through it.
        capsule("pitch", "", (0.0, 0.0, 0.055), (0.0, 0.0, 0.085), 0.013, METAL, kind="cylinder"),
        capsule("pitch", "", (0.0, 0.0, -0.025), (0.0, 0.0, 0.055), 0.0055, METAL, kind="cylinder"),
    ]


def insertion_parts() -> list[str]:
    return [
        capsule("insertion", "sled", (0.020, 0.0, 0.410), (0.020, 0.0, 0.470), 0.017, GREY, 2),
        box("insertion", (0.013, 0.0, 0.440), (0.026, 0.024, 0.036), LIGHT),
        box("insertion", (0.013, 0.0, 0.440), (0.0264, 0.0245, 0.004), ACCENT),
        capsule("insertion", "", (0.0, 0.0, 0.395), (0.0, 0.0, 0.408), 0.010, DARK, kind="cylinder"),
    ]


def roll_parts() -> list[str]:
    wrist = FRAMES["wrist_pitch"][2, 3]
    return [
        capsule("roll", "shaft", (0.0, 0.0, 0.41), (0.0, 0.0, wrist + 0.004), SHAFT_RADIUS, DARK, 3),
        capsule("roll", "", (0.0, 0.0, wrist + 0.011), (0.0, 0.0, wrist + 0.003), 0.00405, METAL, kind="cylinder"),
        capsule("roll", "", (0.0, -0.0036, wrist), (0.0, 0.0036, wrist), 0.0022, METAL, kind="cylinder"),
    ]


def wrist_pitch_parts() -> list[str]:
    pitch, yaw = FRAMES["wrist_pitch"][2, 3], FRAMES["wrist_yaw"][2, 3]
    return [
        capsule("wrist_pitch", "wrist", (0.0, 0.0, pitch), (0.0, 0.0, yaw), 0.0034, METAL, 3),
        capsule("wrist_pitch", "", (-0.0036, 0.0, yaw), (0.0036, 0.0, yaw), 0.0022, GREY, kind="cylinder"),
        '<site name="wrist" pos="0 0 0" size="0.001" group="4"/>',
    ]


def palpator_parts() -> tuple[list[str], list[str]]:
    yaw, length = FRAMES["wrist_yaw"][2, 3], TIP_LENGTH["palpator"]
    tip = (0.0, 0.0, yaw - length)
    return [
        capsule("wrist_yaw", "neck", (0.0, 0.0, yaw), tip, 0.003, METAL, 3),
        ball("tip_ball", tip, 0.005, BRIGHT),
    ], []


def finger(side: int) -> list[str]:
    """One finger of the jaw: its joint opens it by half of the jaw's angle about the wrist's yaw axis."""
    name, yaw, length = ("left", "right")[side < 0], FRAMES["wrist_yaw"][2, 3], TIP_LENGTH["grasper"]
    # The yaw axis is z of the link; across it and the shaft lies the direction in which the fingers open.
    across = np.cross(FRAMES["wrist_yaw"][:3, 2], (0.0, 0.0, -1.0)) * side
    start, end = across * 0.0013 + (0.0, 0.0, yaw - 0.001), across * 0.0011 + (0.0, 0.0, yaw - length + 0.001)
    lower, upper = JAW_RANGE
    return [
        f'<body name="finger_{name}">',
        joint(f"finger_{name}", "finger", 0.5 * lower, 0.5 * upper, JAW_EFFORT, axis=f"0 0 {side}"),
        inertial("finger", "wrist_yaw"),
        capsule("wrist_yaw", f"jaw_{name}", start, end, 0.0011, METAL, 3),
        capsule("wrist_yaw", "", (0.0, 0.0, yaw + 0.001), start, 0.0018, METAL),
        "</body>",
    ]


def grasper_parts() -> tuple[list[str], list[str]]:
    yaw = FRAMES["wrist_yaw"][2, 3]
    clevis = ball("clevis", (0.0, 0.0, yaw), 0.003, METAL)
    return [clevis, *finger(1), *finger(-1)], ["finger_left", "finger_right"]


def long_finger(side: int) -> list[str]:
    """One finger of the retractor's jaw: a pad on an arm, parallel to the other one at a gap of 7 mm."""
    name, yaw, length = ("left", "right")[side < 0], FRAMES["wrist_yaw"][2, 3], TIP_LENGTH["retractor"]
    frame = FRAMES["wrist_yaw"][:3, :3]
    across = np.cross(frame[:, 2], (0.0, 0.0, -1.0)) * side
    middle = across * (PARALLEL_GAP + PAD_HALF[1]) + (0.0, 0.0, yaw - length)
    back = across * (PARALLEL_GAP + 2.0 * PAD_HALF[1])
    knee = back + np.array([0.0, 0.0, yaw - length + PAD_HALF[2] + 0.003])
    end = back + np.array([0.0, 0.0, yaw - length - PAD_HALF[2] + 0.0015])
    width, thickness, long = PAD_HALF
    half = np.abs(frame.T @ (width * frame[:, 2] + thickness * across + long * np.array([0.0, 0.0, 1.0])))
    effort = PAD_FORCE * length
    return [
        f'<body name="finger_{name}">',
        joint(f"finger_{name}", "long_finger", *PAD_RANGE, effort, axis=f"0 0 {side}"),
        inertial("long_finger", "wrist_yaw"),
        f'<geom name="pad_{name}" type="box" pos="{local("wrist_yaw", middle)}" size="{numbers(np.round(half, 12))}" '
        f'group="3" rgba="{BRIGHT}"/>',
        capsule("wrist_yaw", "", (0.0, 0.0, yaw + 0.001), knee, 0.0017, METAL),
        capsule("wrist_yaw", "", knee, end, 0.0012, METAL),
        "</body>",
    ]


def retractor_parts() -> tuple[list[str], list[str]]:
    clevis = ball("clevis", (0.0, 0.0, FRAMES["wrist_yaw"][2, 3]), 0.003, METAL)
    return [clevis, *long_finger(1), *long_finger(-1)], ["finger_left", "finger_right"]


PARTS = {"palpator": palpator_parts, "grasper": grasper_parts, "retractor": retractor_parts}


def model(tool: str) -> str:
    parts, fingers = PARTS[tool]()
    parts.append(
        f'<site name="tip" pos="{numbers(TIP_LENGTH[tool] * TIP_ROTATION[:, 2])}" quat="{quaternion(TIP_ROTATION)}" '
        'size="0.001" group="4"/>'
    )
    drawn = [yaw_parts(), pitch_parts(), insertion_parts(), roll_parts(), wrist_pitch_parts(), parts]
    lines, depth = [], 2
    for link, link_parts in zip(PSM_LINKS, drawn, strict=True):
        still = link.transform(0.0)
        pad = "  " * depth
        place, turn = numbers(np.round(still[:3, 3], 15)), quaternion(still[:3, :3])
        lines.append(f'{pad}<body name="{link.joint}" pos="{place}" quat="{turn}">')
        kind = "slide" if link.prismatic else "hinge"
        lines.append(f"{pad}  {joint(link.joint, link.joint, link.lower, link.upper, link.effort, kind)}")
        lines.append(f"{pad}  {inertial(link.joint, link.joint)}")
        lines.extend(f"{pad}  {part}" for part in link_parts)
        depth += 1
    lines.extend("  " * level + "</body>" for level in range(depth - 1, 1, -1))
    servos = [(link.joint, DRIVE[link.joint]) for link in PSM_LINKS] + [
        (name, DRIVE["long_finger" if tool == "retractor" else "finger"]) for name in fingers
    ]
    actuators = [f'    <position name="hold_{name}" joint="{name}" kp="{kp:g}"/>' for name, (_, _, kp, _) in servos]
    actuators += [f'    <velocity name="drive_{name}" joint="{name}" kv="{kv:g}"/>' for name, (_, _, _, kv) in servos]
    middle = MIDDLE
    if tool == "retractor":
        pads = [f'    <numeric name="roughness_pad_{side}" data="{PAD_ROUGHNESS:g}"/>' for side in ("left", "right")]
        gear = [
            f'    <fixed name="gear" stiffness="{GEAR[0]:g}" damping="{GEAR[1]:g}">',
            '      <joint joint="finger_left" coef="1"/>',
            '      <joint joint="finger_right" coef="-1"/>',
            "    </fixed>",
        ]
        more = ["  <custom>", *pads, "  </custom>", "  <tendon>", *gear, "  </tendon>", "  <actuator>\n"]
        middle = MIDDLE.replace("  <actuator>\n", "\n".join(more))
    return HEAD.format(tool=tool) + "\n".join(lines) + middle + "\n".join(actuators) + TAIL


HEAD = """<!-- A da Vinci-like arm (PSM) with a {tool}. Written by make_psm.py from surgsim_env/instruments/arm/psm.py:
     change it there. The world's origin is the remote centre, -z points into the patient.
     Groups: 1 seen only, 2 outer links, 3 felt by tissue. -->
<mujoco model="psm_{tool}">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.001" integrator="implicitfast" jacobian="dense" gravity="0 0 -9.81">
    <flag autoreset="disable"/>
  </option>
  <default>
    <geom contype="0" conaffinity="0"/>
  </default>
  <worldbody>
"""
MIDDLE = """
  </worldbody>
  <actuator>
"""
TAIL = """
  </actuator>
  <sensor>
    <force name="wrist_force" site="wrist"/>
    <torque name="wrist_torque" site="wrist"/>
  </sensor>
</mujoco>
"""


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for tool in TIP_LENGTH:
        (folder / f"psm_{tool}.xml").write_text(model(tool), encoding="utf-8")
