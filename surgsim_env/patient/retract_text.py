"""The scene of a retraction as the text of a TOML file, with the reasons of its numbers."""

from dataclasses import fields

from msdm_core.support import Support
from surgsim_env.arms.port import Port
from surgsim_env.patient.patient_scene import PatientScene
from surgsim_env.patient.retract_scene import BED_GAP, BED_INSIDE, MODULUS_SPREAD, RetractScene
from surgsim_env.patient.scene_text import FIRST_LINE, tissue_lines
from surgsim_env.patient.toml_lines import comment, entry


def retract_text(found: PatientScene, made: RetractScene) -> str:
    """The text of a scene file; `surgsim_env.scenes.load_scene` reads it."""
    scene = made.anatomy.scene
    tets, retract = scene.mesh.tets, scene.retract
    assert tets is not None and retract is not None
    rows = "; ".join(", ".join(f"{value:.6f}" for value in row) for row in made.frame.T)
    place = ", ".join(f"{value:.6f}" for value in made.origin)
    lines = [
        FIRST_LINE,
        f"# The organ of {comment(', '.join(found.patient.sources))}, turned so that a thin edge of it can be lifted.",
        "# x runs along that edge, y out over it, z up; the bed's top is z = 0. A place p of the patient is here at",
        "# R (p - o) [m], without any change of shape:",
        f"#   o = ({place}), R = ({rows}), one row each.",
        f"# The edge is {made.rim.thickness * 1e3:.0f} mm thick where a jaw takes it. Only the flap around it moves.",
        entry("description", scene.description),
        entry("gravity", scene.gravity, "a scan shows the organ under its weight: that is its rest here"),
        "",
        "[mesh.tets]",
        entry("file", tets.file),
        entry("length_unit", tets.length_unit),
        "",
        *tissue_lines(found, scene),
    ]
    for anchor in scene.anchors:
        assert anchor.box is not None
        box = f"{{ lower = {list(anchor.box.lower)}, upper = {list(anchor.box.upper)} }}"
        lines += ["", "[[anchors]]            # chosen: all but the flap is held", entry("name", anchor.name)]
        lines += [f"box = {box}"]
    for support in scene.supports:
        lines += _bed(support)
    return "\n".join([*lines, *_touch(made), *_retract(made), ""])


def _bed(bed: Support) -> list[str]:
    return [
        "",
        f"[[supports]]           # chosen: it ends {BED_INSIDE * 1e3:g} mm inside the edge: a jaw gets around that",
        entry("name", bed.name),
        entry("kind", bed.kind),
        entry("position", bed.position, f"[m] its top {BED_GAP * 1e3:g} mm below the lowest of the organ above it"),
        entry("size", bed.size),
        entry("friction", bed.friction, "as in the scene lobe"),
    ]


def _touch(made: RetractScene) -> list[str]:
    scene = made.anatomy.scene
    endoscope = scene.endoscope
    assert endoscope is not None and scene.port is not None
    lines = ["", "[contact]              # of tools and of the bed"]
    lines += [entry(name, getattr(scene.contact, name)) for name in ("stiffness", "damping", "friction")]
    lines += [
        "",
        "[instrument]           # the jaw points along the middle of the edge",
        entry("model", scene.instrument.model),
        entry("tip_radius", scene.instrument.tip_radius, "[m] chosen: of a right arm's ball, wider than its neck"),
        entry("approach", scene.instrument.approach),
        entry("tip_direction", scene.instrument.tip_direction),
        *_port("[port]", scene.port),
        *(line for port in scene.ports for line in _port("[[ports]]", port)),
        "",
        "[timing]",
    ]
    lines += [
        entry(name, getattr(scene.timing, name))
        for name in ("haptic_step", "substep_count", "haptic_steps_per_control")
    ]
    lines += ["", "[limits]               # [N] as in the scene lobe: they follow from what its jaw holds"]
    lines += [entry(one.name, getattr(scene.limits, one.name)) for one in fields(scene.limits)]
    lines += ["", "[sensor]               # per axis, as in the scene lobe"]
    lines += [entry(one.name, getattr(scene.sensor, one.name)) for one in fields(scene.sensor)]
    lines += ["", "[palpation]            # not pressed here: patient scenes of palpation are"]
    lines += [entry(name, getattr(scene.palpation, name)) for name in ("press_depth", "face_angle_deg")]
    lines += [
        "",
        "[endoscope]            # on the free side; chosen where what the edge hides is seen once it is lifted",
    ]
    return lines + [entry(one.name, getattr(endoscope, one.name)) for one in fields(endoscope)]


def _port(head: str, port: Port) -> list[str]:
    return ["", f"{head:<22} # as in the scene lobe, as far from the edge", *_all(port)]


def _all(table: object) -> list[str]:
    values = ((one.name, getattr(table, one.name)) for one in fields(table))  # type: ignore[arg-type]
    return [entry(name, value) for name, value in values if value is not None]


def _retract(made: RetractScene) -> list[str]:
    retract = made.anatomy.scene.retract
    assert retract is not None and retract.flap is not None
    reasons = {
        "target_distance": "[m] behind the bed's border, hidden at rest",
        "start_lower": "[m] as far before the edge as in the scene lobe",
        "scale": "a patient's organ has its size",
        "youngs_modulus": f"[Pa] +-{MODULUS_SPREAD:.0%}: normal liver 6.63 +- 1.65 kPa (doi 10.1177/8756479317733713)",
        "capsule_share": "the capsule is the organ's own, above",
    }
    lines = ["", "[retract]              # drawn anew each episode"]
    for one in fields(retract):
        value = getattr(retract, one.name)
        if one.name not in ("camera", "flap") and value is not None:
            lines.append(entry(one.name, value, reasons.get(one.name, "")))
    lines += ["", "[retract.flap]         # [m] what is lifted", *_all(retract.flap)]
    return [*lines, "", "[retract.camera]       # [m], degrees", *_all(retract.camera)]
