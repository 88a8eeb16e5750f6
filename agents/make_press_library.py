"""Make a library of presses, on which a site policy trains at thousands of presses a second; a stopped run continues.

python -m agents.make_press_library --scene phantom --level standard --organs 400 --out runs/phantom_standard.npz
"""

import argparse
from pathlib import Path

from agents.command_line import one_line_errors
from surgsim_env.training.press_library import make_library


def main() -> None:
    """Make a library, or continue one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="phantom")
    parser.add_argument("--level", default="standard")
    parser.add_argument("--organs", type=int, default=400)
    parser.add_argument("--out", type=Path, default=Path("runs/library.npz"))
    arguments = parser.parse_args()
    make_library(arguments.out, arguments.scene, arguments.level, arguments.organs)


if __name__ == "__main__":
    with one_line_errors(__name__):
        main()
