"""Try an installed surgsim where no checkout is: run by the interpreter that it was installed for.

    python tests/packaging/alone.py README.md [--all]

`surgsim doctor` finds nothing broken, the Python code of the README runs, and with --all every environment id is made,
stepped and closed.
"""

import re
import subprocess
import sys
import time
from pathlib import Path

IDS = "import gymnasium, surgsim_env; print(*(name for name in gymnasium.registry if name.startswith('SurgSim/')))"
STEP = """
import gymnasium, surgsim_env
env = gymnasium.make("{name}")
env.reset(seed=0); env.step(env.action_space.sample()); env.close()
"""


def run(*command: str) -> str:
    """Output of a command; it must succeed."""
    begin = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True)
    print(f"{time.perf_counter() - begin:6.1f} s  {command[-1].strip().splitlines()[-1]}", flush=True)
    if done.returncode:
        sys.exit(f"{done.stdout}\n{done.stderr}\nended with {done.returncode}")
    return done.stdout


def main() -> None:
    """Run all of it in the working folder, which must be no checkout."""
    readme, python = Path(sys.argv[1]).read_text(encoding="utf-8"), sys.executable
    place = Path(run(python, "-c", "import surgsim_env; print(surgsim_env.__file__)").strip())
    if "site-packages" not in place.parts:
        sys.exit(f"surgsim_env is imported from {place}; the rule is an installed one: run in another folder")
    for block in re.findall(r"```python\n(.*?)```", readme, re.DOTALL):
        run(python, "-c", block)
    print(run(str(Path(python).with_name("surgsim")), "doctor"))
    if "--all" in sys.argv[2:]:
        for name in run(python, "-c", IDS).split():
            run(python, "-c", STEP.format(name=name))


if __name__ == "__main__":
    main()
