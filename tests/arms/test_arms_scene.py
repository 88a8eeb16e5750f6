"""The scene that turns in a report on two arms: every point by its kind, both arms, ports and wall."""

import base64
import io
import re

import numpy as np
import pytest
import trimesh

from surgsim_apps.arms.arms_in_patient import ArmsInPatient
from surgsim_apps.arms.ports import default_ports
from surgsim_apps.arms.reach import BothArms
from surgsim_apps.arms.reach_kinds import REACH_KINDS, reach_kinds
from surgsim_apps.reports.turning_scene import BRIGHTNESS
from surgsim_env.instruments import SIDES, load_arm
from surgsim_env.scene import load_anatomy, make_scene
from tests.arms.made import made_evaluation

# Triangles of a point's mark.
MARK = 20


@pytest.fixture(scope="module")
def evaluation():
    return made_evaluation()


@pytest.fixture(scope="module")
def parts(evaluation):
    """The meshes of the scene's file by name."""
    ports = default_ports(load_anatomy(make_scene("phantom")))
    arms = tuple(load_arm("psm_palpator", getattr(ports, side).port, tip_radius=0.005) for side in SIDES)
    unknown = np.full(len(evaluation.points), np.nan)
    homes = tuple(np.tile(arm.home, (len(evaluation.points), 1)) for arm in arms)
    both = BothArms(evaluation.both, unknown, unknown, homes)
    (file,) = re.findall('base64_data="([^"]*)"', ArmsInPatient.at_middle(evaluation, arms, both, ports).scene().html)
    return trimesh.load(io.BytesIO(base64.b64decode(file)), file_type="glb").geometry


def test_every_point_has_a_mark_in_the_colour_of_its_kind(evaluation, parts):
    kinds = reach_kinds(evaluation)
    for index, kind in enumerate(REACH_KINDS):
        for name, group in ((kind.name, ~evaluation.inner), (f"{kind.name}, targets inside", evaluation.inner)):
            count = int(((kinds == index) & group).sum())
            assert (len(parts[name].faces) if name in parts else 0) == MARK * count, name
            if count:
                wanted = [BRIGHTNESS * int(kind.colour[place : place + 2], 16) for place in (1, 3, 5)]
                assert parts[name].visual.material.baseColorFactor[:3] == pytest.approx(wanted, abs=1.0)


def test_the_kinds_are_those_of_the_arrays(evaluation):
    left, right, both = evaluation.left.reachable, evaluation.right.reachable, evaluation.both
    wanted = [both, left & ~right, right & ~left, left & right & ~both, ~left & ~right]
    for index, mask in enumerate(wanted):
        assert ((reach_kinds(evaluation) == index) == mask).all()


def test_arms_ports_organ_and_wall_are_there(evaluation, parts):
    kinds = {name for name in parts if name.removesuffix(", targets inside") in [kind.name for kind in REACH_KINDS]}
    assert set(parts) - kinds == {
        *("left arm", "right arm", "left port", "right port", "endoscope port", "endoscope", "organ", "body wall")
    }
    assert len(parts["organ"].faces) == len(evaluation.surface_triangles)
    # All shapes of an arm are as large as one ball's mesh, that of a port.
    shapes = len(load_arm("psm_palpator").shape_radius)
    assert len(parts["left arm"].faces) == shapes * len(parts["left port"].faces)
