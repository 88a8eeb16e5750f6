"""Make the README's picture: python docs/make_pictures.py (about a minute)."""

from pathlib import Path

from rich.console import Console

from surgsim_env.anatomy import load_anatomy
from surgsim_env.palpation.figures import write_organ_picture
from surgsim_env.palpation.job import run_palpation
from surgsim_env.scenes import make_scene

IMAGES = Path(__file__).parent / "images"


def main() -> None:
    IMAGES.mkdir(exist_ok=True)
    palpation = run_palpation(load_anatomy(make_scene("liver")), console=Console())
    write_organ_picture(palpation, IMAGES / "palpation.png")


if __name__ == "__main__":
    main()
