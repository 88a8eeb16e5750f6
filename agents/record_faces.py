"""Record the faces of organs, for training a site policy at thousands of presses a second.

python -m agents.record_faces --scene liver_family --split train --faces 128 --out runs/liver_faces.npz

Of `liver_family`, 128 faces take 80 to 120 minutes of processor time.
"""

import argparse
import sys
from pathlib import Path

from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import lone_run
from surgsim_apps.training.recorded_faces import LANES, record_faces


def main() -> None:
    """Record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="liver_family")
    parser.add_argument("--split", help="of a family, train by default")
    parser.add_argument("--level", default="standard")
    parser.add_argument("--faces", type=int, default=128, help=f"at least so many, in batches of {LANES}")
    parser.add_argument("--out", type=Path, default=Path("runs/faces.npz"))
    arguments = parser.parse_args()
    with lone_run(arguments.out):
        faces = record_faces(
            arguments.scene,
            arguments.split,
            arguments.level,
            arguments.faces,
            progress=lambda done: print(f"{done} of {arguments.faces} faces", flush=True),
        )
        faces.save(arguments.out)


if __name__ == "__main__":
    sys.exit(exit_status(main))
