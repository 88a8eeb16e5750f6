"""How coarse a mesh is against a touch: its cell over the contact radius; above 1 the mesh itself is felt."""

import math
import warnings

# Under a ball on coarser cells than this the force changes by more from site to site than over a deep lesion.
SHARE_LARGEST = 1.0


def contact_radius(tip_radius: float, press_depth: float) -> float:
    """Radius of the patch that a ball touches, sqrt(tip radius x press depth) [m]."""
    return math.sqrt(tip_radius * press_depth)


def share_text(cell: float, tip_radius: float, press_depth: float) -> str:
    """The share in words, with what it means where it is above the largest."""
    share = cell / contact_radius(tip_radius, press_depth)
    text = f"{share:.2f} (cell {cell * 1e3:.3g} mm, tip {tip_radius * 1e3:.3g} mm, pressed {press_depth * 1e3:.3g} mm)"
    return f"{text}: above {SHARE_LARGEST:g}, the mesh itself is felt" if share > SHARE_LARGEST else text


def warn_of_coarse_cells(what: str, cell: float, tip_radius: float, press_depth: float) -> None:
    """A warning where the mesh itself would be felt."""
    radius = contact_radius(tip_radius, press_depth)
    if cell > SHARE_LARGEST * radius:
        warnings.warn(
            f"{what}: cell / contact radius is {share_text(cell, tip_radius, press_depth)}; use cells of at most "
            f"{radius * 1e3:.3g} mm, a larger tip or a deeper press",
            stacklevel=2,
        )
