"""`surgsim maps`: healthy maps of a family's members, made ahead of episodes."""

from dataclasses import dataclass

from rich.console import Console

from surgsim_apps.cli.values import SceneName, Text
from surgsim_env.palpation import member_map, still_template
from surgsim_env.scene import MemberName, family_of, make_scene


@dataclass(frozen=True)
class Maps:
    """Press the healthy members of a family ahead of time: episodes of SurgSim/PalpateSites-v0 need their maps.

    An episode with a member without a map in the cache presses it first, in some seconds.
    """

    scene: SceneName = "liver_family"
    """A shipped family (see `surgsim scenes`) or the scene file of your own (TOML)."""
    split: Text = "train"
    """Its part: train, validation or test."""

    def run(self, console: Console) -> int:
        """Press every member of the split without a map in the cache.

        Raises:
            ValueError: an unknown scene or split, a scene of one organ, a fault during a press.
        """
        template = still_template(make_scene(self.scene))
        family = family_of(template, self.split)
        assert family is not None
        for number in range(family.size):
            member_map(template, MemberName(self.split, number))
        console.print(f"maps of {family.size} members of {self.scene}, split {self.split}", highlight=False)
        return 0
