"""Each lesion that a map does not show has its reason: one organ, in which a lesion can be missed in every way."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from msdm_core.meshing.lattice_meshing import box_mesh
from surgsim_apps.palpate import misses
from surgsim_apps.palpate.contrast_map import Estimate, score_map
from surgsim_apps.palpate.misses import (
    NEAR_SUPPORT,
    NO_MAXIMUM,
    NO_SITE,
    NOISE,
    NOT_FACED,
    TOO_DEEP,
    explain_misses,
)
from surgsim_apps.palpate.truth import seen_from_surface
from surgsim_env.scene.anatomy import anatomy_of
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import Anchor, Ball, Box

PHANTOM = make_scene("phantom")
SPACING = 0.008
ANATOMY = anatomy_of(
    replace(
        PHANTOM,
        anchors=(
            Anchor("floor", box=Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-6))),
            Anchor("clamp", ball=Ball((0.08, 0.04, 0.05), 0.012)),
        ),
        palpation=replace(PHANTOM.palpation, face_margin=0.008, site_spacing=SPACING),
        sensor=replace(PHANTOM.sensor, noise=0.01),
    ),
    box_mesh((0.10, 0.08, 0.05), (10, 8, 5)),
)
U, V = np.meshgrid(np.arange(0.01, 0.0601, SPACING), np.arange(0.01, 0.0701, SPACING))
SITES = np.column_stack([U.ravel(), V.ravel(), np.full(U.size, 0.05)])


def lesion(x, y, z, name="A", radius=0.008):
    return replace(ANATOMY.lesion_at((x, y, z), radius, 8.0, name))


NOWHERE = np.zeros((0, 3))
ABOVE = lesion(0.034, 0.042, 0.036)


def missed(monkeypatch, *lesions, forces=(0.30, 0.20), estimates=(), sites=SITES, early=NOWHERE):
    """The misses of one map with contrast 1 everywhere, where presses feel the forces with and without the lesion."""
    felt = iter(forces * len(lesions))
    monkeypatch.setattr(misses, "scan", lambda *args, **options: [SimpleNamespace(force=next(felt))])
    truths = seen_from_surface(lesions, ANATOMY)
    estimates = [Estimate(np.array(place), 1.5, 0.5) for place in estimates]
    contrast_map = score_map("m", sites, np.ones(len(sites)), estimates, truths, ANATOMY.along_surface, spacing=SPACING)
    return explain_misses(ANATOMY, ANATOMY.organ(lesions), lesions, truths, (contrast_map,), sites, early)


def test_a_lesion_that_is_felt_needs_no_reason(monkeypatch):
    assert missed(monkeypatch, ABOVE, estimates=[(0.036, 0.042, 0.05)]) == ()


@pytest.mark.parametrize(
    ("reason", "lesions", "options"),
    [
        (NOT_FACED, (lesion(0.034, 0.042, 0.012),), {"forces": (0.201, 0.2)}),
        (NEAR_SUPPORT, (lesion(0.08, 0.04, 0.036),), {"forces": (0.201, 0.2)}),
        (NO_SITE, (ABOVE,), {"sites": SITES[:12]}),
        (NOISE, (lesion(0.034, 0.042, 0.030),), {"forces": (0.219, 0.2)}),
        (TOO_DEEP, (lesion(0.034, 0.042, 0.030),), {"forces": (0.221, 0.2)}),
        (NO_MAXIMUM, (ABOVE,), {}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_the_reason(monkeypatch, reason, lesions, options):
    (miss,) = missed(monkeypatch, *lesions, **options)
    assert (miss.map_name, miss.lesion, miss.reason) == ("m", "A", reason)
    assert miss.text.startswith(f"{reason}: ")


def test_a_deep_lesion_that_a_press_feels_all_the_same_is_not_called_hidden(monkeypatch):
    (miss,) = missed(monkeypatch, lesion(0.034, 0.042, 0.012), forces=(0.30, 0.2))
    assert miss.reason == NO_MAXIMUM
