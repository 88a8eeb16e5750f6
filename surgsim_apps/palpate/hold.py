"""How well an organ is held: forces of healthy presses beside Hertz's, and how far the rest of the organ gives way."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.palpation import Press, scan
from surgsim_env.scene import Anatomy, hertz_force

# An organ sways where a node of its farther half moves by more than this share of the tip's depth.
FAR_SHARE_LARGEST = 0.15
# A press that feels less than this share of Hertz's force moves the organ more than it dents it. Held organs of a CT
# felt 0.72 to 0.98 of it, those that swayed 0.15 to 0.75.
FORCE_SHARE_LEAST = 0.6
# Healthy sites that `check_hold` presses.
SITES = 5
WAYS = (
    "raise the stiffness of its [[anchors]], add one where a ligament or fat holds it, or hold it with --anchors "
    "(docs/patient.md)"
)


@dataclass(frozen=True, eq=False)
class Hold:
    """Healthy presses on an organ.

    Fields:
        sites: where it was pressed [m]                                                             (n, 3)
        force: held at the end of each press [N]                                                    (n,)
        expected: of a half space of the same tissue at the same depth (Hertz 1881) [N]             (n,)
        far_share: largest travel of a node in the farther half of the organ over the tip's depth   (n,)
    """

    sites: FloatArray
    force: FloatArray
    expected: FloatArray
    far_share: FloatArray

    @property
    def force_share(self) -> FloatArray:
        """Force over Hertz's, shape (n,)."""
        return self.force / self.expected

    @property
    def faults(self) -> tuple[str, ...]:
        """What is wrong with the organ's support, in sentences; empty for one that is held well."""
        found = []
        worst = int(np.argmax(self.far_share))
        if self.far_share[worst] > FAR_SHARE_LARGEST:
            found.append(
                f"the organ sways: pressed at {_place(self.sites[worst])} mm, its far side moves by "
                f"{self.far_share[worst]:.1%} of the tip's depth; the rule is at most {FAR_SHARE_LARGEST:.0%}"
            )
        share = float(np.median(self.force_share))
        if share < FORCE_SHARE_LEAST:
            found.append(
                f"presses move the organ in place of denting it: they feel {share:.2f} of Hertz's force (median), the "
                f"rule is at least {FORCE_SHARE_LEAST:g}"
            )
        return tuple(f"{one}; lesions may be missed: {WAYS}" for one in found)

    @property
    def text(self) -> str:
        """The figures in one line."""
        low, high = self.force_share.min(), self.force_share.max()
        return (
            f"{len(self.force)} healthy presses feel {self.force.min():.3f} to {self.force.max():.3f} N, {low:.2f} to "
            f"{high:.2f} of Hertz's force; far nodes move by {self.far_share.min():.1%} to {self.far_share.max():.1%} "
            "of the tip's depth"
        )


def hold_of(anatomy: Anatomy, presses: Sequence[Press], *, modulus_factor: float = 1.0) -> Hold | None:
    """How presses of a healthy organ were borne; None where none was complete.

    Args:
        anatomy: the organ.
        presses: of it, healthy.
        modulus_factor: of its tissue.
    """
    whole = [one for one in presses if not one.end and one.depth > 0.0]
    if not whole:
        return None
    scene = anatomy.scene
    expected = [modulus_factor * hertz_force(scene.material, scene.instrument.tip_radius, one.depth) for one in whole]
    return Hold(
        sites=np.array([one.site for one in whole]),
        force=np.array([one.force for one in whole]),
        expected=np.array(expected),
        far_share=np.array([one.far_travel / one.depth for one in whole]),
    )


def check_hold(
    anatomy: Anatomy,
    sites: FloatArray,
    normals: FloatArray,
    *,
    progress: Callable[[], None] = lambda: None,
) -> Hold | None:
    """Press up to SITES of some sites of the healthy organ, spread over them; see `hold_of`.

    Args:
        anatomy: the organ.
        sites: to choose from [m], shape (n_site, 3).
        normals: unit outward normals there, shape (n_site, 3).
        progress: called after each press.
    """
    chosen = np.unique(np.linspace(0, len(sites) - 1, SITES).round().astype(int))
    presses = scan(anatomy, anatomy.organ(), sites[chosen], normals[chosen], progress=progress)
    return hold_of(anatomy, presses)


def _place(point: FloatArray) -> str:
    return ", ".join(f"{value * 1e3:.1f}" for value in point)
