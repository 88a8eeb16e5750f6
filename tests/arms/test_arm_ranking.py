"""Placements and robots are ranked by the rule that the table states."""

from dataclasses import replace

import numpy as np

from surgsim_apps.arms.ranking import rank
from tests.arms.made import made_cycle, made_evaluation


def case(name, *, both, clearance=0.010, force=3.0, left=0.8, right=0.8):
    """A made case: shares of 100 points, the clearance [m] and the force [N] at each of them."""
    evaluation = made_evaluation(count=100, inner_count=0)
    arms = {}
    for side, share in (("left", left), ("right", right)):
        reached = np.arange(100) < round(100 * share)
        arms[side] = replace(
            getattr(evaluation, side),
            reason=np.where(reached, 0, 1).astype(np.int32),
            organ_clearance=np.where(reached, clearance, np.nan),
            wall_clearance=np.where(reached, clearance + 0.02, np.nan),
            tip_force=np.where(reached, force, np.nan),
        )
    return (name, "made", replace(evaluation, both=np.arange(100) < round(100 * both), **arms))


def test_the_share_of_both_comes_first():
    few, many = case("few", both=0.40, clearance=0.02), case("many", both=0.52, clearance=0.024)
    first, second = rank([few, many])
    assert (first.name, second.name) == ("many", "few")


def test_equal_shares_go_by_clearance_then_force_then_order():
    near = case("near", both=0.5, clearance=0.004, force=9.0)
    strong = case("strong", both=0.5, clearance=0.010, force=5.0)
    weak = case("weak", both=0.5, clearance=0.010, force=2.5)
    twin = case("twin", both=0.5, clearance=0.010, force=2.5)
    ranked = rank([near, weak, twin, strong])
    assert [row.name for row in ranked] == ["strong", "weak", "twin", "near"]


def test_differences_below_the_rounding_do_not_rank():
    """Half a millimetre of rounding cannot outrank a newton: 10.2 and 9.8 mm are both 10."""
    ranked = rank([case("a", both=0.5, clearance=0.0102, force=1.0), case("b", both=0.5, clearance=0.0098, force=2.0)])
    assert [row.name for row in ranked] == ["b", "a"]


def test_one_that_reaches_nothing_is_last():
    nothing = case("nothing", both=0.0, left=0.0, right=0.0)
    ranked = rank([nothing, case("little", both=0.0, left=0.02, right=0.0)])
    assert [row.name for row in ranked] == ["little", "nothing"]
    assert np.isnan(ranked[1].clearance)


def test_figures_of_the_rows_are_the_arrays():
    (row,) = rank([case("one", both=0.31, clearance=0.0123, force=4.5, left=0.62, right=0.47)])
    assert (row.both, row.left, row.right, row.either) == (0.31, 0.62, 0.47, 0.62)
    assert (row.clearance, row.force) == (0.0123, 4.5)


def test_both_arms_count_before_either():
    pair, single = case("pair", both=0.4, left=0.5, right=0.5), case("single", both=0.3, left=0.9)
    assert [row.name for row in rank([single, pair])] == ["pair", "single"]


def test_the_median_is_over_both_arms_and_the_nearer_of_organ_and_wall():
    evaluation = made_evaluation(inner_count=5)
    wanted = [
        min(arm.organ_clearance[index], arm.wall_clearance[index])
        for arm in (evaluation.left, evaluation.right)
        for index in np.flatnonzero(arm.reachable)
    ]
    (row,) = rank([("one", "made", evaluation)])
    assert row.clearance == np.median(wanted)
    assert row.both == evaluation.both[:-5].mean()


def test_either_arm_decides_where_both_are_alike():
    more, fewer = case("more", both=0.3, left=0.9), case("fewer", both=0.3)
    first, second = rank([fewer, more])
    assert (first.name, first.either, second.either) == ("more", 0.9, 0.8)


def test_a_patient_who_breathes_is_reached_at_every_position():
    evaluation = made_evaluation()
    evaluation = replace(evaluation, cycle=made_cycle(evaluation))
    (row,) = rank([("one", "made", evaluation)])
    assert (
        row.both == evaluation.cycle.both_always[~evaluation.inner].mean() < evaluation.both[~evaluation.inner].mean()
    )
