"""Hook of hatchling: archives hold the tracked files of a checkout, or all files of an unpacked source archive.

hatchling itself takes whole folders, with what else lies there.
"""

import os
import subprocess
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# Places of files in a wheel, by the begin of their path in a checkout; a source archive holds all at their own place.
WHEEL = {
    "msdm_core/": "msdm_core/",
    "surgsim_apps/": "surgsim_apps/",
    "surgsim_env/": "surgsim_env/",
    "scenes/": "surgsim_env/assets/",
    "agents/policies/": "surgsim_env/assets/agents/policies/",
    "agents/results/": "surgsim_env/assets/agents/results/",
}


class TrackedFiles(BuildHookInterface):
    """Names each file of an archive."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called before a build; an editable install links to the checkout and copies nothing."""
        if version == "editable":
            return
        places = {"": ""} if self.target_name == "sdist" else WHEEL
        build_data["force_include"] |= {
            os.path.join(self.root, file): target + file.removeprefix(begin)
            for file in self._files()
            for begin, target in places.items()
            if file.startswith(begin)
        }

    def _files(self) -> list[str]:
        root = Path(self.root)
        if (root / ".git").exists():
            # Also of another account's checkout, as in a container.
            command = ["git", "-c", "safe.directory=*", "ls-files", "-z"]
            listed = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout
            return [file for file in listed.split("\0") if (root / file).is_file()]
        excluded = self.build_config.exclude_spec
        files = (path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
        return [file for file in files if file != "PKG-INFO" and not excluded.match_file(file)]
