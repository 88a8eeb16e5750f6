"""Make the clips and pictures of environments and tutorials: docs/make_environment_pictures.py [NAME ...] (minutes)."""

import contextlib
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image

import surgsim_env  # noqa: F401  (registers the environments)
from surgsim_apps.reports.output_folder import output_folder
from surgsim_apps.scoring.episodes import episode_facts
from surgsim_apps.training.slide_agents import SlideSweep
from surgsim_env.envs import SurgicalEnv
from surgsim_env.scripting import oracle_script, run_script

IMAGES = Path(__file__).parent / "images"
SIZE = (480, 360)
STEP_MS = 50
PRESSES, PRESS_SHOWN_MS = 16, 600
TUTORIALS = ("organ", "robot")
# Clips of the gallery: size, and steps down and up of a press at a share of the largest speed.
CLIP_SIZE, CLIP_STEPS, CLIP_SPEED = (320, 240), (16, 8), 0.6
ORGANS = (
    *("phantom", "phantom_small", "phantom_wide", "agarose_prism", "bovine_liver_block"),
    *("liver", "liver_family", "kidney_family", "spleen_family"),
)
# Instruments with the organs that they touch.
INSTRUMENTS = {
    "psm_palpator": "liver",
    "six_axis": "liver",
    "psm_grasper": "kidney_family",
    "psm_retractor": "spleen_family",
}


class Filmed(gym.Wrapper):
    """Keeps a picture of every so many steps, one camera beside the other."""

    def __init__(self, env: gym.Env, cameras: tuple[str, ...], every: int) -> None:
        super().__init__(env)
        self.cameras, self.every = cameras, every
        self.frames: list[Image.Image] = []
        self.count = 0

    def step(self, action: Any) -> Any:
        stepped = self.env.step(action)
        if self.count % self.every == 0:
            self.frames.append(frame(self.env, self.cameras))
        self.count += 1
        return stepped


def frame(env: gym.Env, cameras: tuple[str, ...] = ("overview",)) -> Image.Image:
    """The environment as it stands, drawn at twice the size and made smaller."""
    inner = env.unwrapped
    assert isinstance(inner, SurgicalEnv)
    drawn = [Image.fromarray(inner.renderer.rgb(camera)) for camera in cameras]
    return Image.fromarray(
        np.concatenate([np.asarray(picture.resize(SIZE, Image.Resampling.LANCZOS)) for picture in drawn], 1)
    )


def make(id: str, **arguments: Any) -> gym.Env:
    return gym.make(id, render_mode="rgb_array", width=2 * SIZE[0], height=2 * SIZE[1], **arguments)


def write(frames: list[Image.Image], path: Path, milliseconds: int) -> None:
    """A WebP that moves, its last picture shown for a second longer."""
    times = [milliseconds] * (len(frames) - 1) + [milliseconds + 1000]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=times, loop=0, quality=70, method=6)
    print(f"{path.name}: {len(frames)} pictures, {path.stat().st_size / 1000:.0f} kB")


def film_oracle(id: str, path: Path, *cameras: str, seed: int, every: int = 2, **arguments: Any) -> None:
    """The script that knows the truth, doing the task."""
    env = Filmed(make(id, **arguments), cameras, every)
    env.reset(seed=seed)
    run_script(env, oracle_script(env))
    write(env.frames, path, every * STEP_MS)


def film_presses(path: Path, *, seed: int) -> None:
    """A raster of presses, each as it stands at its deepest."""
    env = make("SurgSim/PalpateSites-v0", show_lesion=True)
    env.reset(seed=seed)
    side = round(PRESSES**0.5)
    places = (2.0 * np.arange(side) + 1.0) / side - 1.0
    frames = []
    for row, y in enumerate(places):
        for x in places[:: 1 if row % 2 == 0 else -1]:
            env.step(np.array([x, y], dtype=np.float32))
            frames.append(frame(env))
    write(frames, path, PRESS_SHOWN_MS)


def film_slide(path: Path, *, seed: int) -> None:
    """A sweep over a liver, with the pressure on its surface."""
    env = Filmed(make("SurgSim/Slide-v0", face=True, show_lesion=True), ("overview",), 8)
    agent, over = SlideSweep(), False
    observation, _ = env.reset(seed=seed)
    agent.reset(np.random.default_rng(seed), episode_facts(env, "SurgSim/Slide-v0", {}))
    while not over:
        observation, _, terminated, truncated, _ = env.step(agent.act(observation))
        over = terminated or truncated
    write(env.frames, path, 100)


def film_press(path: Path, scene: str, instrument: str | None = None) -> None:
    """A press above the hidden lesion of an organ, and away."""
    size = {"width": CLIP_SIZE[0], "height": CLIP_SIZE[1]}
    env = gym.make("SurgSim/Palpate-v0", scene=scene, instrument=instrument, render_mode="rgb_array", **size)
    env.reset(seed=4)
    inner = env.unwrapped
    assert isinstance(inner, SurgicalEnv)
    anatomy = inner.simulation.anatomy
    point, outward = anatomy.face.project(inner.task.lesion.centre)
    inner.simulation.restart(point + outward * (anatomy.scene.instrument.tip_radius + 0.004))
    frames = []
    for part, steps in zip((-CLIP_SPEED, CLIP_SPEED), CLIP_STEPS, strict=True):
        for _ in range(steps):
            action = np.zeros(env.action_space.shape or (), dtype=np.float32)
            action[:3] = part * outward
            over = any(env.step(action)[2:4])
            frames.append(Image.fromarray(inner.renderer.rgb("overview")))
            if over:
                break
    write(frames, path, 2 * STEP_MS)
    env.close()


def draw_tutorial(name: str, path: Path) -> None:
    """The picture of a tutorial on one's own organ or robot, by its code."""
    text = (Path(__file__).parent / "tutorials" / f"own_{name}.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for title, code in re.findall(r'^```(?:python|\w+ title="(\w+\.\w+)")\n(.*?)^```$', text, flags=re.M | re.S):
            if title:
                Path(title).write_text(code, encoding="utf-8")
            else:
                exec(code, names)
    Image.fromarray(names["picture"]).save(path, optimize=True)


def main(names: list[str]) -> None:
    films = {
        "palpate": lambda path: film_oracle("SurgSim/Palpate-v0", path, "overview", seed=3, show_lesion=True),
        "palpate_sites": lambda path: film_presses(path, seed=4),
        "slide": lambda path: film_slide(path, seed=5),
        "retract": lambda path: film_oracle("SurgSim/Retract-v0", path, "overview", "endoscope", seed=4),
        "bimanual_retract": lambda path: film_oracle(
            "SurgSim/BimanualRetract-v0", path, "overview", "endoscope", seed=4, every=4
        ),
    }
    with output_folder(IMAGES) as images:
        for name in names or [*films, *ORGANS, *INSTRUMENTS, *TUTORIALS]:
            if name in TUTORIALS:
                draw_tutorial(name, images / f"tutorial_{name}.png")
            elif name in ORGANS:
                film_press(images / f"organ_{name}.webp", name)
            elif name in INSTRUMENTS:
                film_press(images / f"instrument_{name}.webp", INSTRUMENTS[name], name)
            else:
                films[name](images / f"env_{name}.webp")


if __name__ == "__main__":
    main(sys.argv[1:])
