"""Draw a contact sheet of random looks: python docs/make_looks_picture.py (half a minute with compiled kernels)."""

from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import surgsim_env  # noqa: F401  (registers the environments)
from surgsim_env.rendering import LOOK_SPLITS, draw_look, look_generator
from surgsim_env.scripting import oracle_script, run_script

IMAGES = Path(__file__).parent / "images"
EPISODE, SIDE, GAP, ACROSS = 3, 190, 4, 6
# Share of the visible target at which the lobe is drawn.
SHOWN = 0.5


def main() -> None:
    """Fold the lobe until half of the target is visible, and draw it under six looks of each split."""
    env = gym.make("SurgSim/Retract-v0", render_mode="rgb_array", width=SIDE, height=SIDE, show_force=False).unwrapped
    env.reset(seed=EPISODE)
    run = run_script(env, oracle_script(env), seed=EPISODE)
    step = next(index for index, info in enumerate(run.infos) if info["visible"] >= SHOWN)
    env.reset(seed=EPISODE)
    for action in run.action[: step + 1]:
        env.step(action)
    renderer, font = env.renderer, ImageFont.load_default(size=13)  # type: ignore[attr-defined]
    size = (ACROSS * (SIDE + GAP) - GAP, len(LOOK_SPLITS) * (SIDE + GAP) - GAP)
    sheet = Image.new("RGB", size, (255, 255, 255))
    for row, (split, ranges) in enumerate(LOOK_SPLITS.items()):
        rng = look_generator(ranges, EPISODE)
        for column in range(ACROSS):
            renderer.look = draw_look(ranges, rng)
            place = column * (SIDE + GAP), row * (SIDE + GAP)
            sheet.paste(Image.fromarray(np.asarray(renderer.rgb("endoscope"))), place)
        ImageDraw.Draw(sheet).text((6, row * (SIDE + GAP) + 4), split, font=font, fill=(255, 255, 255))
    sheet.save(IMAGES / "looks.webp", quality=88, method=6)


if __name__ == "__main__":
    main()
