"""Organs side by side when one faults, waits or is swapped: what it does alone, and nothing to its neighbours."""

import numpy as np
import pytest

from msdm_core.kernels.structure_kernels import (
    FAULT_CONTACT_LOST,
    FAULT_INVERTED_TET,
    FAULT_NONE,
    FAULT_NOT_FINITE,
    LANE_EMPTY,
    ContactShapes,
    OrganModel,
    OrganState,
    ToolResponse,
)
from msdm_core.lanes.lanes import get_lane, lane_shapes, put_lane, set_lane
from msdm_core.organ.compile import rest_state
from msdm_core.organ.stepping import advance_organ, describe_fault, unyielding
from tests.core.lanes.abreast import advance_lanes
from tests.core.lanes.test_lanes import LAW, SUBSTEP, SUBSTEPS, pressed_organs, pressing, same, tool, varied, yielding


def turn_a_tet_inside_out(organ: OrganModel, state: OrganState, shapes: ContactShapes) -> None:
    a, b, c, d = state.node_position[organ.tet_nodes[200]]
    state.node_position[organ.tet_nodes[200, 0]] += 1.5 * ((b + c + d) / 3.0 - a)


def spoil_a_velocity(organ: OrganModel, state: OrganState, shapes: ContactShapes) -> None:
    state.node_velocity[int(np.argmax(organ.node_rest_position[:, 2])), 1] = np.nan


def throw_the_tool_through(organ: OrganModel, state: OrganState, shapes: ContactShapes) -> None:
    shapes.tool_twist[0] = [0.0, 0.0, -60.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("spoil", "expected", "words"),
    [
        (turn_a_tet_inside_out, FAULT_INVERTED_TET, "turned inside out: volume ratio -"),
        (spoil_a_velocity, FAULT_NOT_FINITE, "no longer finite"),
        (throw_the_tool_through, FAULT_CONTACT_LOST, "contact lost"),
    ],
)
def test_a_fault_stops_its_lane_and_no_other(spoil, expected: int, words: str):
    """Lane 3 faults as alone and stands still for good; its neighbours go on as if nothing had happened."""
    organs = pressed_organs()
    runs = []
    for spoiled in (False, True):
        model, state, shapes, response, wrench = pressing(organs)
        if spoiled:
            single, own = get_lane(state, 3), lane_shapes(shapes, 3)
            spoil(organs[3], single, own)
            put_lane(state, 3, single)
            lonely = ContactShapes(*(array.copy() for array in own))
            own_response = ToolResponse(*(array[3].copy() for array in response))
            own_wrench = np.zeros((1, 6))
            for calls in range(1, 20):  # noqa: B007
                alone = advance_organ(organs[3], single, lonely, LAW, SUBSTEP, SUBSTEPS, own_wrench, own_response)
                faults = advance_lanes(model, state, shapes, LAW, SUBSTEP, SUBSTEPS, wrench, response)
                assert faults[3] == alone
                if alone:
                    break
            assert alone == expected
            assert wrench[3].tobytes() == own_wrench.tobytes()
            stopped = get_lane(state, 3)
            assert same(stopped, single) == []
            assert words in describe_fault(organs[3], stopped, int(faults[3]))
            before = [array[3].copy() for array in (*shapes, *response)]
        else:
            calls = 0
        runs.append((state, shapes, wrench, calls))
        for _ in range(50 - calls if spoiled else 50):
            faults = advance_lanes(model, state, shapes, LAW, SUBSTEP, SUBSTEPS, wrench, response)
            assert faults.tolist() == [0, 0, 0, expected if spoiled else 0, 0, 0, 0, 0]
        if spoiled:
            assert not wrench[3].any()
            assert same(get_lane(state, 3), stopped) == []
            for array, old in zip((*shapes, *response), before, strict=True):
                assert array[3].tobytes() == old.tobytes()
    (state, shapes, wrench, _), (other, other_shapes, other_wrench, _) = runs
    for lane in (0, 1, 2, 4, 5, 6, 7):
        assert same(get_lane(state, lane), get_lane(other, lane)) == []
        assert wrench[lane].any() and wrench[lane].tobytes() == other_wrench[lane].tobytes()
        for mine, theirs in zip(lane_shapes(shapes, lane), lane_shapes(other_shapes, lane), strict=True):
            assert mine.tobytes() == theirs.tobytes()
    put_lane(other, 3, rest_state(organs[3], shape_count=2))
    assert other.lane_fault[3] == FAULT_NONE, "a restart forgets the fault"


def test_a_lane_that_is_told_to_wait_goes_on_where_it_was():
    """Lane 3 waits 30 haptic steps in mid-press (LANE_EMPTY): nothing of it changes; then it runs on as if at once."""
    organs = pressed_organs()
    model, state, shapes, response, wrench = pressing(organs)
    unbroken = pressing(organs)
    before = get_lane(state, 3)
    state.lane_fault[3] = LANE_EMPTY
    for _ in range(30):
        advance_lanes(model, state, shapes, LAW, SUBSTEP, SUBSTEPS, wrench, response)
    assert same(get_lane(state, 3), before) == [] and not wrench[3].any()
    state.lane_fault[3] = FAULT_NONE
    for _ in range(30):
        assert not advance_lanes(model, state, shapes, LAW, SUBSTEP, SUBSTEPS, wrench, response).any()
        advance_lanes(*unbroken[:3], LAW, SUBSTEP, SUBSTEPS, unbroken[4], unbroken[3])
    assert wrench[3, 0, 2] != 0.0
    assert same(get_lane(state, 3), get_lane(unbroken[1], 3)) == []


def test_swapping_one_lanes_organ_leaves_the_others():
    """A new lesion and a restart of lane 2 in mid-press: it runs as that organ alone from rest, the others go on."""
    organs = pressed_organs()
    model, state, shapes, response, wrench = pressing(organs)
    reference = pressing(organs)
    fresh = varied(organs[0], 99)
    with pytest.raises(ValueError, match="read-only"):
        model.spring_stiffness[0, 0] = 1.0
    set_lane(model, 2, fresh)
    put_lane(state, 2, rest_state(fresh, shape_count=2))
    for array, new in zip(lane_shapes(shapes, 2), tool(2), strict=True):
        array[:] = new
    single, own, own_response, own_wrench = rest_state(fresh, shape_count=2), tool(2), unyielding(1), np.zeros((1, 6))
    own_response.tool_mobility[:] = yielding().tool_mobility
    for _ in range(100):
        advance_organ(fresh, single, own, LAW, SUBSTEP, SUBSTEPS, own_wrench, own_response)
        assert not advance_lanes(model, state, shapes, LAW, SUBSTEP, SUBSTEPS, wrench, response).any()
        assert not advance_lanes(*reference[:3], LAW, SUBSTEP, SUBSTEPS, reference[4], reference[3]).any()
    assert own_wrench[0, 2] != 0.0
    for lane in range(8):
        expected = single if lane == 2 else get_lane(reference[1], lane)
        assert same(get_lane(state, lane), expected) == [], f"lane {lane}"
