"""Where the scene files lie: in an installed wheel, else in the checkout."""

from pathlib import Path

PACKAGE_FOLDER = Path(__file__).resolve().parent


def scenes_folder(package_folder: Path = PACKAGE_FOLDER) -> Path:
    """The folder with `organs/`, `instruments/` and `meshes/`.

    A wheel carries it inside the package, a checkout next to the package. Both are looked for beside this file and
    nowhere else: an editable install also leaves a copy in site-packages, which goes stale and is never read.

    Args:
        package_folder: the folder of the package `surgsim_env`.

    Raises:
        FileNotFoundError: neither place has it; names both and the way out.
    """
    places = (package_folder / "scenes", package_folder.parent / "scenes")
    for place in places:
        if (place / "organs").is_dir():
            return place
    looked = " nor in ".join(str(place) for place in places)
    raise FileNotFoundError(
        f"surgsim's scene files are neither in {looked} (a folder `scenes` with `organs` in it is expected); "
        "reinstall surgsim, or run from a complete checkout"
    )
