"""Hold of an organ: forces of healthy presses beside Hertz's, and travel of its far side."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.palpation import Press, scan
from surgsim_env.scene import Anatomy, hertz_force

# An organ sways where a node of its farther half moves by more than this share of the tip's depth.
FAR_SHARE_LARGEST = 0.15
# Below this share of Hertz's force a press moves the organ more than it dents it. Held organs of a CT
# felt 0.72 to 0.98 of it, swaying ones 0.15 to 0.75.
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
        sites: of the presses [m]                                                                   (n, 3)
        force: held at the end of each press [N]                                                    (n,)
        slope: dF/dd at the end of each press [N/m]                                                 (n,)
        expected: of a half space of the same tissue at the same depth (Hertz 1881) [N]             (n,)
        far_share: largest travel of a node in the farther half of the organ over the tip's depth   (n,)
    """

    sites: FloatArray
    force: FloatArray
    slope: FloatArray
    expected: FloatArray
    far_share: FloatArray

    @property
    def force_share(self) -> FloatArray:
        """Force over Hertz's, shape (n,)."""
        return self.force / self.expected

    @property
    def faults(self) -> tuple[str, ...]:
        """Faults of the organ's support in sentences; empty for a well-held organ."""
        faults = []
        worst = int(np.argmax(self.far_share))
        if self.far_share[worst] > FAR_SHARE_LARGEST:
            faults.append(
                f"the organ sways: pressed at {place_text(self.sites[worst])} mm, its far side moves by "
                f"{self.far_share[worst]:.1%} of the tip's depth; the rule is at most {FAR_SHARE_LARGEST:.0%}"
            )
        share = float(np.median(self.force_share))
        if share < FORCE_SHARE_LEAST:
            faults.append(
                f"presses move the organ in place of denting it: they feel {share:.2f} of Hertz's force (median), the "
                f"rule is at least {FORCE_SHARE_LEAST:g}"
            )
        return tuple(f"{fault}; lesions may be missed: {WAYS}" for fault in faults)

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
    """Hold of a healthy organ by its presses; None without a complete press.

    Args:
        anatomy: the organ.
        presses: of the organ without lesions.
        modulus_factor: of its tissue.
    """
    complete = [press for press in presses if not press.end and press.depth > 0.0]
    if not complete:
        return None
    scene = anatomy.scene
    tip = scene.instrument.tip_radius
    expected = [modulus_factor * hertz_force(scene.material, tip, press.depth) for press in complete]
    return Hold(
        sites=np.array([press.site for press in complete]),
        force=np.array([press.force for press in complete]),
        slope=np.array([press.slope for press in complete]),
        expected=np.array(expected),
        far_share=np.array([press.far_travel / press.depth for press in complete]),
    )


def check_hold(
    anatomy: Anatomy,
    sites: FloatArray,
    normals: FloatArray,
    *,
    progress: Callable[[], None] = lambda: None,
) -> Hold | None:
    """Hold of an organ by healthy presses at up to SITES of its sites, spread over them.

    Args:
        anatomy: the organ.
        sites: of its raster [m], shape (n_site, 3).
        normals: unit outward normals there, shape (n_site, 3).
        progress: called after each press.
    """
    chosen = np.unique(np.linspace(0, len(sites) - 1, SITES).round().astype(int))
    presses = scan(anatomy, anatomy.organ(), sites[chosen], normals[chosen], progress=progress)
    return hold_of(anatomy, presses)


def place_text(point: FloatArray) -> str:
    """Coordinates of a point (3,) [m] in millimetres."""
    return ", ".join(f"{value * 1e3:.1f}" for value in point)
