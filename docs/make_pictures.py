"""Make the pictures of README, docs/scripting.md and docs/retraction.md: python docs/make_pictures.py (a minute)."""

from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image

from surgsim_apps.palpate.figures import write_organ_picture
from surgsim_apps.palpate.palpation import run_palpation
from surgsim_apps.reports.output_folder import output_folder
from surgsim_env.coupling import Simulation
from surgsim_env.envs import SurgicalEnv
from surgsim_env.rendering import OrganRenderer, RenderOptions
from surgsim_env.scene import load_anatomy, make_scene
from surgsim_env.scripting import Hold, Lift, MoveTo, PressUntil, oracle_script, run_script

IMAGES = Path(__file__).parent / "images"
# Options and camera of each quarter of the picture of the views.
VIEWS = (
    ({}, "overview"),
    ({}, "endoscope"),
    ({"show_lesion": True}, "overview"),
    ({"cut_away": True}, "overview"),
)


def write_views(path: Path) -> None:
    """The liver under a press on its second lesion, four times: whole, by endoscope, translucent, cut open."""
    anatomy = load_anatomy(make_scene("liver"))
    lesions = anatomy.demonstration_lesions()
    pressed = lesions[1]
    simulation = Simulation(anatomy)
    point, outward = anatomy.face.project(pressed.centre)
    simulation.reset(anatomy.organ(lesions), point + outward * (anatomy.scene.instrument.tip_radius + 0.001))
    simulation.instrument.command_velocity(-0.02 * outward)
    simulation.control_step(330)
    simulation.end_control_step()
    pictures = []
    for options, camera in VIEWS:
        shown = RenderOptions(width=960, height=720, **options)
        renderer = OrganRenderer(simulation, shown, lesions=[pressed, *lesions[:1], *lesions[2:]])
        small = Image.fromarray(renderer.rgb(camera)).resize((480, 360), Image.Resampling.LANCZOS)
        pictures.append(np.asarray(small))
        renderer.close()
    rows = [np.concatenate(pictures[:2], axis=1), np.concatenate(pictures[2:], axis=1)]
    Image.fromarray(np.concatenate(rows)).save(path, quality=88, method=6)


def write_trace(path: Path) -> None:
    """The first script of docs/scripting.md, as its trace draws itself."""
    script = [MoveTo((0.030, 0.030, 0.042)), PressUntil(0.30, max_depth=0.006), Hold(0.5), Lift(0.010)]
    run_script(gym.make("SurgSim/Palpate-v0", scene="phantom"), script, seed=0).plot(path)


def write_retraction(path: Path) -> None:
    """The oracle's retraction of a lobe at rest, grasped and folded back, from above and through the endoscope."""
    env = gym.make("SurgSim/Retract-v0", width=1280, height=960)
    env.reset(seed=4)
    inner = env.unwrapped
    assert isinstance(inner, SurgicalEnv)
    *approach, lift, fold, wait = oracle_script(env)
    columns = []
    for part in ([], approach, [lift, fold, wait]):
        if part:
            run_script(env, part)
        shots = [Image.fromarray(inner.renderer.rgb(camera)) for camera in ("overview", "endoscope")]
        small = [np.asarray(shot.resize((400, 300), Image.Resampling.LANCZOS)) for shot in shots]
        columns.append(np.concatenate(small))
    Image.fromarray(np.concatenate(columns, axis=1)).save(path, optimize=True)
    env.close()


def main() -> None:
    with output_folder(IMAGES) as images:
        write_trace(images / "trace.png")
        write_views(images / "views.webp")
        write_retraction(images / "retraction.png")
        palpation = run_palpation(load_anatomy(make_scene("liver")))
        write_organ_picture(palpation, images / "palpation.png")


if __name__ == "__main__":
    main()
