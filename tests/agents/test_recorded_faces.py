"""Recorded faces: what is recorded is what the environment feels, and a recording is a surrogate to learn on."""

import sys
from dataclasses import fields, replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from agents import record_faces as script
from surgsim_apps.training import recorded_faces
from surgsim_apps.training.recorded_faces import (
    FIRST_SEED,
    LANES,
    load_faces,
    record_faces,
)
from surgsim_apps.training.site_agent import observed_facts
from surgsim_apps.training.site_surrogate import SiteSurrogate
from surgsim_env.palpation.chart import MAP_SIDE, interpolated
from surgsim_env.tasks.declaration import reward_weights
from surgsim_env.tasks.palpate_sites import PalpateSitesTask
from surgsim_env.tasks.runtime import TaskRuntime

pytestmark = pytest.mark.agents
FACES = Path(script.__file__).parent / "faces"


def shortened(recorded, count, first=0):
    """Some faces of a recording, over and over."""
    rows = np.arange(first, first + count) % len(recorded)
    return replace(recorded, **{field.name: getattr(recorded, field.name)[rows] for field in fields(recorded)})


def test_a_face_is_drawn_as_it_was_recorded():
    """Its map, contrasts and lesions; a press at the site over a lesion finds it."""
    recorded = load_faces(FACES / "phantom_standard_held.npz")
    for number, face in enumerate(recorded.faces[:6]):
        env = SiteSurrogate(lambda rng, face=face: face)
        observation, _ = env.reset(seed=number)
        facts = observed_facts(observation)
        np.testing.assert_allclose(facts.extent * face.tip_radius, recorded.extent[number], rtol=1e-5)
        assert facts.map.pressable.tolist() == recorded.pressable[number].tolist()
        site = int(np.flatnonzero(face.map.pressable)[number])
        observation, *_ = env.step(face.map.places[site].astype(np.float32))
        assert env.sites == [site]
        assert env.values[0] == pytest.approx(recorded.log_contrast[number, site], abs=5.0 * face.estimator.noise)
        assert len(face.truth) == np.isfinite(recorded.truth[number]).all(axis=1).sum()


def test_pressing_everywhere_finds_lesions_and_pays_them_once():
    recorded = load_faces(FACES / "phantom_standard_held.npz")
    face = next(face for face in recorded.faces if len(face.truth) == 1)
    env = SiteSurrogate(lambda rng: face)
    env.reset(seed=7)
    share, total, over, rng = env.found_share, 0.0, False, np.random.default_rng(0)
    sites = face.map.places[face.map.pressable]
    while not over:
        _, reward, over, _, info = env.step(sites[rng.integers(len(sites))].astype(np.float32))
        total += reward
    gained = reward_weights(PalpateSitesTask)["found"] * (env.found_share - share)
    assert gained + reward_weights(PalpateSitesTask)["error"] <= total <= gained and info["error_mm"] >= 0.0


def test_draws_are_of_all_faces():
    recorded, rng = shortened(load_faces(FACES / "phantom_standard_held.npz"), 3), np.random.default_rng(0)
    drawn = [recorded(rng) for _ in range(60)]
    assert {id(face) for face in drawn} == {id(face) for face in recorded.faces}


@pytest.mark.parametrize("path", sorted(FACES.glob("*.npz")), ids=lambda path: path.stem)
def test_the_recordings_of_the_checkout_can_be_learned_on(path):
    """Drawn as the environment draws: lesions that reach below sites, and contrasts that rise above them."""
    recorded = load_faces(path)
    assert len(recorded) % LANES == 0
    for face in recorded.faces:
        points = face.surface(face.map.sites[face.map.pressable] * face.tip_radius)
        contrast = face.log_contrast[face.map.pressable]
        for lesion in face.truth:
            over = np.linalg.norm(points - lesion, axis=1) < face.estimator.lesion_radius
            assert contrast[over].max() > np.median(contrast)


@pytest.fixture
def few_presses(monkeypatch):
    """Two organs at once, a few sites of each."""
    monkeypatch.setattr(recorded_faces, "LANES", 2)
    monkeypatch.setattr(recorded_faces, "SITE_STEP", 4)


def test_each_batch_is_drawn_as_the_first(few_presses, tmp_path, monkeypatch):
    """At level "clinical" an episode draws the map's shift after the sensor's bias and drift."""

    def recorded(name, faces):
        options = ("--scene", "phantom_small", "--level", "clinical", "--faces", str(faces))
        monkeypatch.setattr(sys, "argv", ["record_faces", *options, "--out", str(tmp_path / name)])
        script.main()
        return load_faces(tmp_path / name)

    both = recorded("both.npz", 3)
    assert len(both) == 4
    monkeypatch.setattr(recorded_faces, "FIRST_SEED", FIRST_SEED + 2)
    second = recorded("second.npz", 2)
    np.testing.assert_array_equal(both.truth[2:], second.truth)
    np.testing.assert_array_equal(both.log_contrast[2:], second.log_contrast)


def test_a_press_beyond_the_hard_limit_ends_the_recording(few_presses, monkeypatch):
    monkeypatch.setattr(TaskRuntime, "force_limit", 0.02)
    monkeypatch.setattr(PalpateSitesTask, "end", lambda _, step: "hard_force" if step.force_peak > 0.02 else "")
    with pytest.raises(RuntimeError, match=rf"episode {FIRST_SEED}, site \d+: the press ended it, .* the hard limit"):
        record_faces("phantom_small", None, "standard", 1)


@pytest.mark.slow
def test_what_is_recorded_is_what_the_environment_feels():
    """At the recorded sites to float32's forces, between them within a few hundredths."""
    recorded = record_faces("phantom_small", None, "standard", 1)
    env = gym.make("SurgSim/PalpateSites-v0", scene="phantom_small", level="standard").unwrapped
    for number in (0, 5):
        env.reset(seed=FIRST_SEED + number)
        env.task.reading.sensor = replace(env.task.reading.sensor, noise=0.0, bias=0.0)
        env.task.reading.bias = np.zeros(3)
        face, task = recorded.faces[number], env.task
        np.testing.assert_allclose(face.truth, task.truth)
        middle = np.array([[0.3, -0.4]])
        np.testing.assert_allclose(
            interpolated(recorded.surface[number], middle), task.charted.surface(middle), atol=1e-3
        )
        even = ((face.map.numbers - MAP_SIDE // 2) % 2 == 0).all(axis=1)
        rng = np.random.default_rng(0)
        for sites, tolerance in ((face.map.pressable & even, 0.01), (face.map.pressable & ~even, 0.06)):
            for site in rng.choice(np.flatnonzero(sites), 3, replace=False).tolist():
                env.step(face.map.places[site].astype(np.float32))
                assert task.felt.last.log_contrast == pytest.approx(face.log_contrast[site], abs=tolerance)
