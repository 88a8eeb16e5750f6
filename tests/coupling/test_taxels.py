"""Taxels: their forces against the wrench and the contact points, in lanes, saved, and through their sensor model."""

import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_env.coupling.sensors import TaxelReading
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import load_scene, make_scene, scenes_folder, with_instrument
from surgsim_env.scene.model import Taxels
from surgsim_env.scripting import oracle_script, run_script

EXACT = 1e-12


def pressed(taxels: Taxels, aside: tuple[float, float] = (0.0, 0.0), depth: float = 0.003, clearance: float = 0.001):
    """A simulation of phantom_small with the tip pressed beside the middle of its face, then drawn sideways."""
    scene = with_instrument(make_scene("phantom_small"), "tactile_probe")
    scene = replace(scene, instrument=replace(scene.instrument, taxels=taxels))
    anatomy = load_anatomy(scene)
    simulation, radius = Simulation(anatomy), scene.instrument.tip_radius
    middle = anatomy.face.points.mean(axis=0)
    top = anatomy.face.points[:, 2].max()
    simulation.reset(anatomy.organ(), np.array([middle[0] + aside[0], middle[1] + aside[1], top + radius + clearance]))
    simulation.instrument.command_velocity(np.array([0.0, 0.0, -0.04]))
    simulation.control_step(round((depth + clearance) / 0.04 / simulation.haptic_dt))
    return simulation


def scene_text(name: str) -> str:
    return (scenes_folder() / "organs" / f"{name}.toml").read_text(encoding="utf-8")


def in_world(simulation: Simulation) -> np.ndarray:
    """Sum of the forces on each patch on the world's axes [N], (n_patch, 3)."""
    patches = simulation.instrument.patches
    return np.einsum("pi,pij->pj", simulation.taxels.sum(axis=(1, 2)), patches.axes)


@pytest.mark.parametrize("shape", [(4, 4), (1, 1), (3, 7)])
def test_their_sum_is_the_wrench_of_the_haptic_step_pressed_and_sliding(shape):
    simulation = pressed(Taxels(*shape, pitch=0.002))
    for velocity in (np.zeros(3), np.array([0.02, -0.01, 0.0])):
        simulation.instrument.command_velocity(velocity)
        simulation.control_step(40)
        force = simulation.contact_force
        assert force[2] > 0.1
        np.testing.assert_allclose(in_world(simulation)[0], force, rtol=0, atol=EXACT * np.linalg.norm(force))
        assert simulation.taxels.shape == (1, *shape, 3)
    # Dragged along: shear on the taxels too, against the motion.
    assert np.abs(simulation.taxels[..., :2]).sum() > 0.05 * force[2]


def test_their_centre_is_that_of_the_contact_points():
    """Weights keep the mean place of contact points within the patch."""
    simulation = pressed(Taxels(4, 4, pitch=0.004), aside=(0.009, 0.004))
    simulation.instrument.command_velocity(np.zeros(3))
    simulation.control_step(100)
    points = simulation.contact_points()
    push = points.force[:, 2]
    expected = push @ points.place[:, :2] / push.sum()
    normal = simulation.taxels[..., 2]
    measured = (normal[..., None] * simulation.instrument.patches.places[..., :2]).sum(axis=(0, 1, 2)) / normal.sum()
    # One takes the mean of the last haptic step, the other the next substep, of a tip at rest.
    np.testing.assert_allclose(measured, expected, rtol=0, atol=1e-6)
    assert (normal > -1e-6).all() and normal[0, 1:3, 1:3].sum() > 0.5 * normal.sum()


def test_each_taxel_lies_on_the_tip():
    simulation = pressed(Taxels(3, 3, pitch=0.002))
    places = simulation.instrument.patches.places - simulation.instrument.tip_position
    radius = simulation.anatomy.scene.instrument.tip_radius
    np.testing.assert_allclose(np.linalg.norm(places, axis=-1), radius, rtol=1e-12)
    np.testing.assert_allclose(places[0, 1, 1], [0.0, 0.0, -radius], atol=1e-12)
    assert np.ptp(places[..., :2], axis=(0, 1, 2)) == pytest.approx([0.004, 0.004])


def test_a_patch_beside_the_contact_feels_it_at_its_border():
    """A lattice of 1 mm around the pole under a contact of 5 mm: the outer taxels bear what lies beyond."""
    simulation = pressed(Taxels(5, 5, pitch=0.001))
    normal = simulation.taxels[0, :, :, 2]
    border = np.ones((5, 5), dtype=bool)
    border[1:-1, 1:-1] = False
    assert normal[border].mean() > normal[~border].mean()


def test_no_taxels_no_forces():
    simulation = Simulation(load_anatomy(make_scene("phantom_small")))
    assert simulation.taxels is None and simulation.instrument.taxel_shape == (0, 0, 0, 3)


def test_pads_of_a_jaw_feel_what_their_fingers_do(tmp_path):
    """Grasp and pull with the grasper of a scene, whose file gives its pads taxels."""
    scene = tmp_path / "felt.toml"
    scene.write_text(f"{scene_text('lobe')}\n[instrument.taxels]\nrows = 2\ncolumns = 3\n")
    env = gym.make("SurgSim/Retract-v0", scene=str(scene)).unwrapped
    seen = []

    class Reader(gym.Wrapper):
        def step(self, action):
            result = self.env.step(action)
            simulation = env.simulation
            jaw = simulation.instrument.jaw
            seen.append((in_world(simulation), simulation.contact_wrench[jaw.tools, :3], simulation.taxels))
            return result

    reader = Reader(env)
    reader.reset(seed=0)
    run_script(reader, oracle_script(reader))
    sums, wrench, taxels = (np.array(part) for part in zip(*seen, strict=True))
    size = np.abs(wrench).max()
    assert size > 0.3 and taxels.shape[1:] == (2, 2, 3, 3)
    np.testing.assert_allclose(sums, wrench, rtol=0, atol=EXACT * size)
    # Both pads are pressed.
    gripped = np.abs(wrench).sum(axis=(1, 2)).argmax()
    assert (taxels[gripped, ..., 2].sum(axis=(1, 2)) > 0.1).all()


def test_lanes_feel_what_each_organ_feels_alone():
    settings = {"scene": "phantom_small", "instrument": "tactile_probe"}
    envs = gym.make_vec("SurgSim/Palpate-v0", num_envs=2, **settings)
    alone = [gym.make("SurgSim/Palpate-v0", **settings) for _ in range(2)]
    envs.reset(seed=[0, 1])
    for seed, env in enumerate(alone):
        env.reset(seed=seed)
    action = np.array([[0.3, 0.1, -1.0, 0.0], [0.0, 0.2, -0.8, 0.0]], dtype=np.float32)
    felt = False
    for _ in range(12):
        observation, *_ = envs.step(action)
        for lane, env in enumerate(alone):
            assert env.step(action[lane])[0].tobytes() == observation[lane].tobytes()
            simulation = envs.unwrapped.envs[lane].unwrapped.simulation
            assert simulation.taxels.tobytes() == env.unwrapped.simulation.taxels.tobytes()
            felt |= simulation.taxels.any()
    assert felt


def test_a_saved_state_has_them():
    env = gym.make("SurgSim/PalpateSites-v0", scene="phantom_small", instrument="tactile_probe", budget=4).unwrapped
    env.reset(seed=3)
    env.step(np.array([0.2, 0.1], dtype=np.float32))
    state, first = env.save_state(), env.step(np.array([-0.2, 0.1], dtype=np.float32))
    env.reset(seed=4)
    env.load_state(state)
    assert env.step(np.array([-0.2, 0.1], dtype=np.float32))[0].tobytes() == first[0].tobytes()
    assert first[0][env.observation_slices["taxels"]].any()


def test_an_arms_file_declares_them(tmp_path, monkeypatch):
    """The da Vinci-like palpator: four taxels around the pole of its tip, for a file named from the working folder."""
    monkeypatch.chdir(tmp_path)
    folder = scenes_folder() / "instruments"
    (tmp_path / "psm_palpator.xml").write_text((folder / "psm_palpator.xml").read_text(encoding="utf-8"))
    own, text = tmp_path / "own.toml", (folder / "psm_palpator.toml").read_text(encoding="utf-8")
    own.write_text(f"{text}\n[taxels]\nrows = 2\ncolumns = 2\n")
    env = gym.make("SurgSim/Palpate-v0", scene="phantom", instrument=own.name).unwrapped
    env.reset(seed=0)
    while np.linalg.norm(env.simulation.contact_force) < 0.1:
        env.step(env.layout.action([0.0, 0.0, -0.02]).astype(np.float32))
    simulation = env.simulation
    size = np.linalg.norm(simulation.contact_force)
    assert env.observation_slices["taxels"].stop == env.observation_space.shape[0]
    np.testing.assert_allclose(in_world(simulation)[0], simulation.contact_force, rtol=0, atol=EXACT * size)
    pole = simulation.instrument.patches.places.mean(axis=(0, 1, 2)) - simulation.instrument.tip_position
    tip = simulation.instrument.arm.tip_direction(simulation.instrument.data.qpos[:6])
    assert pole @ tip > 0.99 * np.linalg.norm(pole)


# ---- the sensor model ------------------------------------------------------------------------------------------------

RNG = np.random.default_rng(0)
SHAPE = (2, 3, 4, 3)


def test_cross_talk_goes_to_neighbours_and_changes_no_sum():
    reading = TaxelReading(Taxels(3, 4, noise=0.0, cross_talk=0.4), SHAPE)
    force = np.zeros(SHAPE)
    force[0, 1, 1, 2], force[1, 0, 0, 0] = 1.0, 1.0
    read, saturated = reading.read(force, RNG, 0.0)
    assert not saturated
    np.testing.assert_allclose(read[0, :, :, 2], [[0.0, 0.1, 0.0, 0.0], [0.1, 0.6, 0.1, 0.0], [0.0, 0.1, 0.0, 0.0]])
    np.testing.assert_allclose(read[1, :, :, 0], [[0.8, 0.1, 0.0, 0.0], [0.1, 0.0, 0.0, 0.0], [0.0] * 4], atol=1e-15)
    np.testing.assert_allclose(read.sum(axis=(1, 2)), force.sum(axis=(1, 2)), atol=1e-15)


def test_noise_drift_and_range():
    still = TaxelReading(Taxels(3, 4, noise=0.002), SHAPE)
    read = np.array([still.read(np.zeros(SHAPE), RNG, 0.0)[0] for _ in range(400)])
    assert read.std() == pytest.approx(0.002, rel=3.0 / math.sqrt(read.size))
    drifting = TaxelReading(Taxels(3, 4, noise=0.0, drift=1e-4), SHAPE)
    drifting.reset(RNG)
    assert np.ptp(drifting.drift) > 1e-4 and np.abs(drifting.drift).max() <= 1e-4
    np.testing.assert_allclose(drifting.read(np.zeros(SHAPE), RNG, 5.0)[0], 5.0 * drifting.drift)
    again = drifting.restored(drifting.get_state())
    np.testing.assert_array_equal(again.drift, drifting.drift)
    read, saturated = TaxelReading(Taxels(3, 4, noise=0.0, range=0.5), SHAPE).read(np.full(SHAPE, 0.7), RNG, 0.0)
    assert saturated and (read == 0.5).all()


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("rows = 0", r"taxels\.rows is 0; it must be from 1 to 64"),
        ("columns = 65", r"taxels\.columns is 65"),
        ("pitch = 0.0", r"taxels\.pitch is 0 m; it must be finite and above 0"),
        ("cross_talk = 1.0", r"taxels\.cross_talk is 1; it must be at least 0 and below 1"),
        ("noise = -0.1", r"taxels\.noise is -0\.1 N"),
        ("range = 0.0", r"taxels\.range is 0 N"),
        ("rws = 4", r"entry 'rws' is unknown there; did you mean 'rows'"),
    ],
)
def test_wrong_descriptions_are_refused(tmp_path, entry, message):
    path = tmp_path / "wrong.toml"
    path.write_text(f"{scene_text('phantom_small')}\n[instrument.taxels]\n{entry}\n")
    with pytest.raises(ValueError, match=message):
        load_scene(path)


def test_a_pair_of_arms_with_taxels_is_refused(tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(f"{scene_text('lobe')}\n[instrument.taxels]\nrows = 2\n")
    scene = load_scene(path)
    paired = replace(scene, instrument=replace(scene.instrument, model="psm_pair"))
    with pytest.raises(ValueError, match="pairs of arms do not read them"):
        Simulation(load_anatomy(paired))
