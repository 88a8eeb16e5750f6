"""SurgSim/Retract-v0: what it draws."""

import math

import numpy as np
import pytest

from surgsim_env.tasks.retract import HIDDEN_SHARE


def check_draws(env, seeds):
    """Everything in its range and nothing of the target in view; returns the draws."""
    table, endoscope = env.scene.retract, env.scene.endoscope
    drawn = []
    for seed in seeds:
        _, info = env.reset(seed=seed)
        draw = env.task.drawn
        assert info["visible"] <= HIDDEN_SHARE
        assert table.scale[0] <= draw.scale <= table.scale[1]
        assert table.youngs_modulus[0] <= draw.youngs_modulus <= table.youngs_modulus[1]
        assert np.linalg.norm(np.subtract(draw.eye, endoscope.position)) <= 0.005
        views = np.subtract(draw.looks_at, draw.eye), np.subtract(endoscope.target, endoscope.position)
        cosine = views[0] @ views[1] / np.linalg.norm(views[0]) / np.linalg.norm(views[1])
        assert math.degrees(math.acos(min(cosine, 1.0))) <= 5.0
        assert 0.015 <= draw.target[1] <= 0.030
        edge = env.task.tracked_nodes[:5]
        rest = env.simulation.organ_model.node_rest_position[edge]
        np.testing.assert_allclose(rest[:, 1], 0.052 * draw.scale, rtol=1e-12)
        sag = rest[:, 2] - env.simulation.organ_state.node_position[edge, 2]
        assert (0.0 < sag).all() and (sag < 0.012 * draw.scale).all(), "lower than at rest, by less than the thickness"
        drawn.append(draw)
    return drawn


@pytest.mark.slow
def test_draws_are_in_their_ranges_and_hide_the_target(shared_retract):
    drawn = check_draws(shared_retract, range(15))
    assert len(set(drawn)) == 15
    capsules = [draw.capsule_stiffness > 0.0 for draw in drawn]
    assert any(capsules) and not all(capsules)


def test_the_organ_is_the_one_that_was_drawn(shared_retract):
    shared_retract.reset(seed=3)
    drawn, model = shared_retract.task.drawn, shared_retract.simulation.organ_model
    extent = np.ptp(model.node_rest_position, axis=0)
    np.testing.assert_allclose(extent, np.array([0.08, 0.052, 0.012]) * drawn.scale, rtol=1e-12)
    held = model.node_inverse_mass == 0.0
    assert held.any() and (model.node_rest_position[held, 1] <= 1e-9).all()
    along = model.node_rest_position[held, 0]
    assert np.ptp(along) <= drawn.held_share * extent[0] * (1.0 + 1e-6)


@pytest.mark.slow
def test_a_target_in_plain_view_is_drawn_again(shared_retract, monkeypatch):
    seen = iter([0.5, 0.11, 0.02])
    monkeypatch.setattr(shared_retract.task, "_look", lambda _: next(seen, 0.02))
    _, info = shared_retract.reset(seed=4)
    assert info["visible"] == 0.02 and next(seen, None) is None
    monkeypatch.setattr(shared_retract.task, "_look", lambda _: 1.0)
    with pytest.raises(ValueError, match="none of 20 draws"):
        shared_retract.reset(seed=4)
