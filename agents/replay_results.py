"""Play the first episodes of scores again, and note in each file the source with which they are the same.

python -m agents.replay_results [FILE ...] --episodes 16

An edit of the source that changes no episode, such as an import moved, changes the digest in a result's `origin`, and
`surgsim evaluate --check` then finds that it was played with another source. To play all of them again takes hours.
This plays the first episodes of each file that is given (default: those in agents/results that were played with
another source). Where errors after each press, lesions and successes are the file's, `origin` gets the versions and
digests of here, and `origin.replayed` the number of episodes and the digests with which all were played. Where they
are not, the file is left alone, and the exit status is 1. Errors are the same to the last digit that a file has of
them: processors differ in the last bits of a float, and now and then an error is rounded the other way. Of
environments other than SurgSim/PalpateSites-v0 a file has the success of each episode alone, which is a weak check:
play all of those where anything may have changed.
"""

import argparse
import shlex
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from agents.command_line import one_line_errors
from surgsim_env.cli.main import main as surgsim
from surgsim_env.scoring.origin import check_origin
from surgsim_env.scoring.results import Result, load_result, shipped_results

# Entries of a result with one value for each episode.
PER_EPISODE = ("seeds", "errors_mm", "lesion_counts", "successes")
# Of an error in a file [mm], with what a float adds.
LAST_DIGIT_MM = 0.01 + 1e-9


def played_again(result: Result, episodes: int) -> Result:
    """The result's command once more, for its first episodes.

    Raises:
        ValueError: the command fails (names it).
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "result.json"
        command = [*shlex.split(result.command)[1:], "--episodes", str(episodes), "--submit", str(file)]
        try:
            status = surgsim(command)
        except SystemExit as end:
            status = end.code
        if status:
            raise ValueError(f"surgsim {shlex.join(command)} ends with {status}")
        return load_result(file)


def differences(result: Result, again: Result) -> Iterator[str]:
    """In what the first episodes of a result differ from those that were played again."""
    for name in PER_EPISODE:
        for seed, one, other in zip(again.seeds, getattr(result, name), getattr(again, name), strict=False):
            if not (_close(one, other) if name == "errors_mm" else one == other):
                yield f"{name} of seed {seed}: {one} in the file, {other} here"
    for name, digest in result.origin["agent"].items():
        if again.origin["agent"].get(name) != digest:
            yield f"{name} of the agent is another file"
    if again.origin["dtype"] != result.origin["dtype"]:
        yield f"dtype is {result.origin['dtype']} in the file, {again.origin['dtype']} here"


def _close(errors: list[float], others: list[float]) -> bool:
    return len(errors) == len(others) and np.allclose(errors, others, rtol=0.0, atol=LAST_DIGIT_MM)


def noted(result: Result, again: Result) -> Result:
    """The result with the origin of the episodes that were played again."""
    first = result.origin.get("replayed", {}).get("environment", result.origin["environment"])
    return replace(result, origin={**again.origin, "replayed": {"episodes": len(again.seeds), "environment": first}})


def main() -> None:
    """Replay the files of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--episodes", type=int, default=16)
    given = parser.parse_args()
    if given.episodes < 1:
        raise ValueError(f"--episodes is {given.episodes}; it must be at least 1")
    failed = 0
    for file in given.files or sorted(shipped_results().glob("[!r]*.json")):
        result = load_result(file)
        if not given.files and not (result.origin and any(check_origin(result))):
            continue
        again = played_again(result, given.episodes)
        found = list(differences(result, again))
        if found:
            failed += 1
            print(f"{file}: DIFFERS: {'; '.join(found)}")
        else:
            noted(result, again).write(file)
            print(f"{file}: the same in {len(again.seeds)} episodes")
    if failed:
        raise SystemExit(1)


if __name__ == "__main__":
    with one_line_errors(__name__):
        main()
