"""Make the picture of families in docs/palpation.md: python docs/make_family_picture.py (half a minute)."""

from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image

import surgsim_env  # noqa: F401  (registers the ids)

IMAGES = Path(__file__).parent / "images"
# A row for each family, episodes of these seeds; the first that play different members are shown.
FAMILIES, MEMBERS = ("liver_family", "kidney_family", "spleen_family"), 5
WIDTH, HEIGHT = 300, 220


def pictures(scene: str) -> np.ndarray:
    """Members of a family beside each other, their hidden lesions shown, (HEIGHT, MEMBERS * WIDTH, 3)."""
    settings = {"render_mode": "rgb_array", "width": WIDTH, "height": HEIGHT, "show_lesion": True, "show_force": False}
    env = gym.make("SurgSim/Palpate-v0", scene=scene, level="standard", **settings)
    shown: dict[str, np.ndarray] = {}
    seed = 0
    while len(shown) < MEMBERS:
        _, info = env.reset(seed=seed)
        if info["member"] not in shown:
            shown[info["member"]] = np.asarray(env.render())
        seed += 1
    env.close()
    return np.concatenate(list(shown.values()), axis=1)


def main() -> None:
    """One row of members a family."""
    rows = np.concatenate([pictures(scene) for scene in FAMILIES], axis=0)
    Image.fromarray(rows).save(IMAGES / "families.webp", quality=82)


if __name__ == "__main__":
    main()
