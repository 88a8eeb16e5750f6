"""Sites of a palpation."""

import numpy as np

from msdm_core.arithmetic import norm
from msdm_core.mesh import FloatArray
from surgsim_env.scene import SUPPORT_TIP_RADII, Anatomy, Ball


def plan_sites(anatomy: Anatomy, around: Ball | None = None) -> tuple[FloatArray, FloatArray, int]:
    """Raster sites [m] and normals, each (n_site, 3), clear of supports; number of sites too near to a support.

    Args:
        anatomy: the organ.
        around: ball around the sites; default: the whole palpable face.

    Raises:
        ValueError: no site is left.
    """
    scene = anatomy.scene
    sites, normals = anatomy.face.raster(scene.palpation.site_spacing)
    if around is not None:
        inside = norm(sites - np.asarray(around.centre), axis=1) <= around.radius
        sites, normals = sites[inside], normals[inside]
    free = anatomy.clear_of_supports(sites)
    if not free.any():
        tip = scene.instrument.tip_radius * 1e3
        raise ValueError(
            f"scene {scene.name!r}: no site to press: {len(sites)} raster sites lie on the palpable face (inside the "
            f"ball asked for, if any), all within {SUPPORT_TIP_RADII * tip:g} mm of a fixed support or {tip:g} mm of "
            "an elastic one: use a smaller site_spacing or face_margin, turn the approach, or move the anchors"
        )
    return sites[free], normals[free], int((~free).sum())
