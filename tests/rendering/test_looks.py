"""Random looks: they repeat with the seed, leave the simulation alone, and those of evaluation are held out."""

import colorsys
import dataclasses
import itertools

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.rendering.cameras import Camera
from surgsim_env.rendering.looks import (
    CAMERA_ROLL,
    CAMERA_SHIFT,
    FOV_FACTOR,
    TEST,
    TRAIN,
    LookRanges,
    draw_look,
    look_generator,
)
from surgsim_env.rendering.vessels import AXIS_COUNT, TEXTURE_WIDTH, texture_places, vessel_texture

RETRACT = "SurgSim/Retract-v0"
needs_opengl = pytest.mark.usefixtures("opengl")
BANDS = [entry.name for entry in dataclasses.fields(LookRanges) if entry.name.endswith("_bands")]


def still(env):
    """An action that moves nothing."""
    return np.zeros(env.action_space.shape, dtype=np.float32)


# ---- draws ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", BANDS)
def test_training_and_evaluation_share_no_hue_and_no_vessel_spacing(name):
    for band, other in itertools.product(getattr(TRAIN, name), getattr(TEST, name)):
        assert band[1] < other[0] or other[1] < band[0]
        # What is held out lies near what is trained on: within the range of all bands.
        assert abs(band[0] - other[0]) < 200.0


def hue(colour):
    """[degrees], from -90 to 270."""
    degrees = 360.0 * colorsys.rgb_to_hsv(*colour)[0]
    return degrees - 360.0 if degrees > 270.0 else degrees


@pytest.mark.parametrize(("ranges", "other"), [(TRAIN, TEST), (TEST, TRAIN)])
def test_draws_lie_in_their_own_bands_alone(ranges, other):
    rng = look_generator(ranges, 5)
    looks = [draw_look(ranges, rng) for _ in range(200)]
    for name, values in (
        ("tissue_hue_bands", [hue(look.tissue) for look in looks]),
        ("drape_hue_bands", [hue(look.drape) for look in looks]),
        ("target_hue_bands", [hue(look.target) for look in looks]),
        ("vessel_bands", [look.vessel_density for look in looks]),
    ):
        for value in values:
            assert any(low - 1e-6 <= value <= high + 1e-6 for low, high in getattr(ranges, name))
            assert not any(low <= value <= high for low, high in getattr(other, name))
        for low, high in getattr(ranges, name):
            assert any(low <= value <= high for value in values), "every band is drawn from"


def test_streams_are_of_seed_and_split():
    """The same seed gives the same numbers; another seed, or the other split, others than that or the environment's."""
    drawn = {
        (ranges.stream, seed): look_generator(ranges, seed).integers(2**62, size=4).tolist()
        for ranges in (TRAIN, TEST)
        for seed in (0, 1)
    }
    assert look_generator(TRAIN, 1).integers(2**62, size=4).tolist() == drawn[TRAIN.stream, 1]
    episodes = [np.random.default_rng(seed).integers(2**62, size=4).tolist() for seed in (0, 1)]
    everything = [number for numbers in (*drawn.values(), *episodes) for number in numbers]
    assert len(set(everything)) == len(everything)


def test_a_camera_is_moved_within_its_ranges():
    camera = Camera.looking(np.array([0.0, -0.1, 0.05]), np.zeros(3), np.array([0.0, 0.0, 1.0]), 60.0)
    rng = look_generator(TRAIN, 3)
    for _ in range(50):
        seen = draw_look(TRAIN, rng).seen_from(camera)
        distance = np.linalg.norm(camera.target - camera.position)
        assert np.linalg.norm(seen.position - camera.position) <= CAMERA_SHIFT[1] * distance * (1 + 1e-9)
        assert FOV_FACTOR[0] <= seen.fov / 60.0 <= FOV_FACTOR[1]
        np.testing.assert_allclose(seen.rotation.T @ seen.rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(seen.rotation) == pytest.approx(1.0)
        # The rotation of the picture, from the upright direction's place in it.
        upright = seen.rotation.T @ camera.up
        assert abs(np.degrees(np.arctan2(-upright[0], upright[1]))) <= CAMERA_ROLL[1] + 1e-9


# ---- vessels -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("density", [80.0, 200.0, 300.0])
def test_vessels_are_as_dense_as_said(density):
    """A straight line crosses so many a metre; Rice's formula gives 2 f sqrt(1/2) of waves of frequency f in a plane.

    A wave whose direction is random has the frequency f cos(angle) along the line, and the mean of cos^2 is 1/2.
    """
    counts = []
    for seed in range(20):
        # About two pixels wide, so that none is missed.
        shade = vessel_texture(seed, density, 1.0, density / 1000.0)[..., 0]
        dark = shade < 250
        counts.append((dark[:, 1:] & ~dark[:, :-1]).sum() / len(dark) / TEXTURE_WIDTH)
    expected = density * np.sqrt(0.5)
    # The lengths of the waves spread by 30 %.
    assert np.mean(counts) == pytest.approx(expected, rel=0.3)


def test_each_triangle_is_stretched_by_sqrt_3_at_most():
    """Projected along the axis nearest to its normal n, an area shrinks by the largest |n_i|, at least 1 / sqrt(3)."""
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(60, 3))
    faces = rng.permutation(60).reshape(20, 3).astype(np.int32)
    places, face_places = texture_places(vertices, faces)
    assert places.shape == (AXIS_COUNT * 60, 2)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    edge, two = (places[face_places[:, k]] - places[face_places[:, 0]] for k in (1, 2))
    flat = np.abs(edge[:, 0] * two[:, 1] - edge[:, 1] * two[:, 0]) * TEXTURE_WIDTH**2
    assert (flat <= area * (1 + 1e-4)).all() and (flat >= area / np.sqrt(3.0) * (1 - 1e-4)).all()


# ---- environments ---------------------------------------------------------------------------------------------------


@needs_opengl
def test_a_seed_repeats_pictures_to_the_bit_and_changes_nothing_else():
    """Beside an environment without looks, which draws on the same stage in turn and is not changed by it either."""
    settings = {"obs_mode": "rgb_force"}
    plain, looked, again = (
        gym.make(RETRACT, **settings).unwrapped,
        gym.make(RETRACT, **settings, looks="train").unwrapped,
        gym.make(RETRACT, **settings, looks="train").unwrapped,
    )
    before = plain.reset(seed=4)[0]["picture"]
    first, _ = looked.reset(seed=4)
    again.reset(seed=9)
    second, _ = again.reset(seed=4)
    np.testing.assert_array_equal(first["picture"], second["picture"])
    assert (plain.reset(seed=4)[0]["picture"] == before).all(), "the stage's own look is restored"
    assert (before != first["picture"]).mean() > 0.5
    for env in (plain, looked, again):
        env.action_space.seed(0)
    for _ in range(3):
        action = plain.action_space.sample()
        first, two, three = plain.step(action), looked.step(action), again.step(action)
        assert first[0]["force"].tobytes() == two[0]["force"].tobytes() and first[1:] == two[1:]
        np.testing.assert_array_equal(two[0]["picture"], three[0]["picture"])
        assert plain.task_observation.tobytes() == looked.task_observation.tobytes()
    # Without a seed the next look is another one, and the same in both.
    first, second = looked.reset()[0], again.reset()[0]
    np.testing.assert_array_equal(first["picture"], second["picture"])
    assert looked.look == again.look and looked.look != draw_look(TRAIN, look_generator(TRAIN, 4))
    for env in (plain, looked, again):
        env.close()


@needs_opengl
def test_a_loaded_state_has_its_look():
    env, other = (gym.make(RETRACT, obs_mode="rgb", looks="test").unwrapped for _ in range(2))
    env.reset(seed=1)
    seen = env.step(still(env))[0]
    other.reset(seed=2)
    other.load_state(env.save_state())
    np.testing.assert_array_equal(other.observation, seen)
    env.reset()
    other.reset()
    assert env.look == other.look
    plain = gym.make(RETRACT, obs_mode="rgb").unwrapped
    plain.reset(seed=1)
    for receiver, state in ((other, plain.save_state()), (plain, other.save_state())):
        with pytest.raises(ValueError, match=r"entry 'look' is (missing|unknown)"):
            receiver.load_state(state)
    plain.close()
    env.close()
    other.close()


@needs_opengl
def test_noise_is_of_the_moment():
    """The same moment looks the same however often it is drawn; the next one has other noise."""
    env = gym.make(RETRACT, obs_mode="rgb", looks="train").unwrapped
    env.reset(seed=1)
    noisy, clean = (dataclasses.replace(env.look, noise=noise) for noise in (0.05, 0.0))
    first, quiet = env.picture(noisy), env.picture(clean)
    np.testing.assert_array_equal(env.picture(noisy), first)
    noise = (first.astype(float) - quiet)[(quiet > 40) & (quiet < 215)]
    assert noise.std() == pytest.approx(0.05 * 255.0, rel=0.05)
    env.step(still(env))
    assert (env.picture(noisy) != first).mean() > 0.5
    env.close()


@needs_opengl
def test_force_beside_the_picture_is_what_the_sensor_reads():
    env, state = gym.make(RETRACT, obs_mode="rgb_force").unwrapped, gym.make(RETRACT).unwrapped
    (seen, _), (numbers, _) = env.reset(seed=2), state.reset(seed=2)
    slices = state.observation_slices
    wanted = [numbers[slices[name]] for name in ("contact_force", "contact_torque", "grip_force", "pull_force")]
    np.testing.assert_array_equal(seen["force"], np.concatenate(wanted))
    assert set(seen) == {"picture", "force"}
    without = gym.make(RETRACT, obs_mode="rgb_force", observe_force=False).unwrapped
    assert not without.reset(seed=2)[0]["force"].any()
    env.close()
    without.close()


@needs_opengl
def test_observed_pictures_are_plain():
    """Those of a renderer in the plain style, to the bit."""
    drawn = {"render_mode": "rgb_array", "camera": "endoscope", "width": 84, "height": 84, "style": "plain"}
    seen = gym.make(RETRACT, obs_mode="rgb").unwrapped
    env = gym.make(RETRACT, **drawn, show_force=False, smooth_edges=False).unwrapped
    env.reset(seed=2)
    np.testing.assert_array_equal(seen.reset(seed=2)[0], env.render())
    seen.close()
    env.close()
