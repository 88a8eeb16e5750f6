"""Submissions: the digest of an agent's files, and the seeds of its episodes, which follow from it.

Nobody knows the seeds before the files are final, and everybody who has the files can repeat them.
"""

import hashlib
import itertools
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

# Version of the rule for seeds, part of each.
PROTOCOL = "surgsim submission 1"
# Seeds of submissions are from this to twice this less 1; public and training seeds are smaller.
SEED_LEAST = 2**31


def submission_seeds(digest: str, env_id: str, scene: str, level: str) -> Iterator[int]:
    """Seeds of a submission without end, at least SEED_LEAST and below 2 SEED_LEAST.

    Seed n = 0, 1, ... is SEED_LEAST plus the last 31 bits of the SHA-256 of the lines PROTOCOL, `digest`, `env_id`,
    `scene`, `level` and n.
    """
    for number in itertools.count():
        lines = "\n".join((PROTOCOL, digest, env_id, scene, level, str(number)))
        yield SEED_LEAST + int(hashlib.sha256(lines.encode()).hexdigest(), 16) % SEED_LEAST


def module_digest(name: str) -> str:
    """`files_digest` of an imported module's file; of a module in a package, of all files of the outermost package."""
    outermost = sys.modules[name.partition(".")[0]]
    if not hasattr(outermost, "__path__"):
        return files_digest({name: Path(str(outermost.__file__))})
    folder = Path(next(iter(outermost.__path__)))
    paths = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return files_digest({path.relative_to(folder).as_posix(): path for path in paths})


def files_digest(files: Mapping[str, Path]) -> str:
    """SHA-256 of a file, or, of several, of their list by name as `sha256sum` prints it."""
    digests = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()}
    if len(digests) == 1:
        return digests.popitem()[1]
    return hashlib.sha256("".join(f"{digests[name]}  {name}\n" for name in sorted(digests)).encode()).hexdigest()
