"""Environments on an organ that breathes keep the promises that those on one that holds still keep."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from msdm_core.organ.motion import SIGNAL
from surgsim_env.coupling.motion import CYCLE_COUNT, draw_drive
from surgsim_env.coupling.motion_kernels import signal_at
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.coupling.tracking import FRAME_DELAY, SurfaceTracker
from surgsim_env.palpation.site_press import SitePress, press_alone, press_phases
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.model import CyclicMotion
from surgsim_env.scene.motions import list_motions, make_motion, with_motion
from surgsim_env.scene.save import as_toml
from surgsim_env.scripting import Hold, oracle_script, run_script
from surgsim_env.scripting.steps import Tracked

BREATH = CyclicMotion(
    "breathing",
    (0.004, 0.0, 0.001),
    period=(0.5, 0.7),
    rise=0.3,
    fall=0.5,
    variation=0.1,
    stops_in_apnoea=True,
)
BEAT = CyclicMotion(
    "heartbeat", (0.0, 0.0, 0.002), period=(0.2, 0.3), rise=0.2, fall=0.3, centre=(0.0, 0.0, 0.0), reach=0.05
)


@pytest.fixture(scope="module")
def scene():
    return replace(make_scene("phantom_small"), name="breathing", motions=(BREATH, BEAT))


@pytest.fixture(scope="module")
def anatomy(scene):
    return load_anatomy(scene)


@pytest.fixture(scope="module")
def scene_file(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "breathing.toml"
    path.write_text(as_toml(scene))
    return str(path)


def test_cycles_rise_fall_and_rest():
    """From the definition: 0 before the first cycle, its size at u_r, smooth everywhere, and no cycle like another."""
    drive = draw_drive((BREATH, BEAT), 1e-3, np.random.default_rng(4))
    for number, motion in enumerate((BREATH, BEAT)):
        start, size, delay = drive.cycle_start[number], drive.cycle_size[number], drive.delay[number]
        assert 0.0 <= delay <= motion.period[1] and signal_at(drive, number, delay) == 0.0
        lengths = np.diff(start)
        for cycle in (0, 7, CYCLE_COUNT - 1):
            begin, length = delay + start[cycle], lengths[cycle]
            assert signal_at(drive, number, begin + motion.rise * length) == pytest.approx(size[cycle], rel=1e-9)
            assert signal_at(drive, number, begin + 0.5 * motion.rise * length) == pytest.approx(0.5 * size[cycle])
            assert abs(signal_at(drive, number, begin + (motion.rise + motion.fall) * length)) < 1e-9
            assert signal_at(drive, number, begin + 0.99 * length) == pytest.approx(0.0, abs=1e-12)
        time = np.arange(0.0, 3.0, 1e-4)
        speed = np.diff([signal_at(drive, number, moment) for moment in time]) / 1e-4
        # The largest acceleration: |p''| is at most 10 / sqrt(3).
        bend = size.max() * 10.0 / (np.sqrt(3.0) * (min(motion.rise, motion.fall) * lengths.min()) ** 2)
        assert np.abs(np.diff(speed)).max() < 1.05 * bend * 1e-4
        assert (np.ptp(lengths) > 1e-9) == (np.ptp(size) > 1e-9) == (motion.variation > 0.0)


def test_the_ground_is_where_the_signals_say_after_each_haptic_step(scene):
    anatomy = load_anatomy(scene)
    simulation = Simulation(anatomy)
    simulation.draw_motion(np.random.default_rng(2))
    at_rest = simulation.organ_state.node_position[anatomy.anchors].copy()
    farthest = 0.0
    for _ in range(900):
        assert simulation.haptic_step()
        signals = [signal_at(simulation.drive, number, simulation.time) for number in range(2)]
        shift = sum(s * motion.shift(at_rest) for s, motion in zip(signals, anatomy.ground_motions, strict=True))
        np.testing.assert_allclose(simulation.organ_state.node_position[anatomy.anchors], at_rest + shift, atol=1e-12)
        farthest = max(farthest, float(np.abs(shift).max()))
    assert farthest > 0.003


def patient(anatomy, seed=3) -> Simulation:
    simulation = Simulation(anatomy)
    simulation.draw_motion(np.random.default_rng(seed))
    return simulation


def course(simulation, count, switch=None) -> np.ndarray:
    """Signals (count, n_motion) after each of some haptic steps; `switch` holds the breath or lets it go on by step."""
    rows = []
    for step in range(count):
        if switch and step in switch:
            simulation.hold_breath(switch[step])
        assert simulation.haptic_step()
        rows.append(simulation.organ_state.motion[:, SIGNAL].copy())
    return np.array(rows)


def test_a_held_breath_ends_and_rests_and_the_heart_goes_on(anatomy):
    """Held and let go in the middle of a breath, in its rest, and twice in one breath: the ground never jumps."""
    simulation = patient(anatomy)
    assert not simulation.holds_breath
    drive = simulation.drive
    # The breaths drawn first begin at 54 and 593 ms; that at 1700 ms is as long as the first.
    switch = {200: True, 300: False, 700: True, 1700: False, 1850: True, 1900: False, 1930: True}
    breath, heart = course(simulation, 2600, switch).T
    assert simulation.holds_breath
    # p' is at most 15 / 8.
    for number, signal in enumerate((breath, heart)):
        shortest = np.diff(drive.cycle_start[number]).min() * min(drive.rise[number], drive.fall[number])
        fastest = 15.0 / 8.0 * drive.cycle_size[number].max() / shortest
        assert np.abs(np.diff(signal, prepend=0.0)).max() <= fastest * simulation.haptic_dt
    assert breath[[200, 300, 700, 1850, 1900, 1930]].min() > 0.1
    # A breath moves in 0.8 of its time. Rates that are summed up leave rounding errors.
    for rest in (slice(1000, 1700), slice(2200, 2600)):
        assert np.abs(breath[rest]).max() < 1e-15
        assert np.ptp(heart[rest]) > 0.5
    assert simulation.drive.delay[0] == pytest.approx(1.7)


def test_a_breath_stays_held_when_the_drawn_cycles_come_again(scene):
    """After the last cycle comes the first: that one must not be breathed."""
    quick = replace(BREATH, displacement=(1e-5, 0.0, 0.0), period=(0.02, 0.02), variation=0.0)
    simulation = patient(load_anatomy(replace(scene, motions=(quick,))))
    signal = course(simulation, round(1.1 * CYCLE_COUNT * 0.02 / simulation.haptic_dt), {25: True})[:, 0]
    assert signal[20:40].max() > 0.01 and np.abs(signal[60:]).max() < 1e-15


def test_a_restart_begins_the_drawn_course_again_with_the_breath_as_it_is(anatomy):
    simulation = patient(anatomy)
    parked = simulation.instrument.parked
    drawn = course(simulation, 1000)
    simulation.restart(parked)
    course(simulation, 700, {200: True})
    simulation.restart(parked)
    held = course(simulation, 1000)
    assert simulation.holds_breath and not held[:, 0].any()
    assert held[:, 1].tobytes() == drawn[:, 1].tobytes()
    simulation.hold_breath(False)
    assert course(simulation, 300)[:, 0].any()
    simulation.restart(parked)
    assert course(simulation, 1000).tobytes() == drawn.tobytes()


def test_a_state_saved_in_a_held_breath_goes_on_to_the_bit(anatomy):
    """While the last breath ends, and while none is left; what was drawn is restored too."""
    simulation, other = patient(anatomy), patient(anatomy, seed=5)
    for count in (250, 700):
        simulation.restart(simulation.instrument.parked)
        simulation.hold_breath(False)
        simulation.restart(simulation.instrument.parked)
        course(simulation, count, {200: True})
        state = simulation.get_state()
        expected = course(simulation, 600, {400: False})
        node_position = simulation.organ_state.node_position.copy()
        other.set_state(simulation.organ_model, state)
        assert other.holds_breath
        assert course(other, 600, {400: False}).tobytes() == expected.tobytes()
        assert other.organ_state.node_position.tobytes() == node_position.tobytes()
        # Letting go began a cycle at once; a restart goes back to what was drawn.
        for twin in (simulation, other):
            twin.restart(twin.instrument.parked)
        assert course(other, 300).tobytes() == course(simulation, 300).tobytes()
        assert other.organ_state.motion[0, SIGNAL] > 0.1


def test_what_a_scene_says_of_motion_is_checked():
    for changes, named in (
        ({"rise": 0.7, "fall": 0.5}, "rise"),
        ({"size": (2.0, 1.0)}, "size"),
        ({"variation": 0.9}, "variation is 0.9"),
        ({"side": (0.0, 0.0, 1.0)}, "reach"),
    ):
        with pytest.raises(ValueError, match=named):
            replace(BREATH, **changes)


# ---- presets ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in list_motions() if name != "none"])
def test_a_preset_moves_towards_feet_and_front(name):
    """On the shipped liver, x to the left, y to the back, z to the head; a probe along z takes the front away."""
    breathing, heartbeat = make_motion(name).motions
    liver = with_motion(make_scene("liver"), name)
    for motion, preset in zip(liver.motions, (breathing, heartbeat), strict=True):
        assert motion.displacement == pytest.approx((0.0, -preset.anterior, -preset.caudal))
    assert liver.motions[0].stops_in_apnoea and not liver.motions[1].stops_in_apnoea
    along = replace(liver, instrument=replace(liver.instrument, approach=(0.0, 0.0, -1.0)))
    assert with_motion(along, name).motions[0].displacement == pytest.approx((0.0, 0.0, -breathing.caudal))
    # The heart moves what is near the organ's upper end, most there.
    points = load_anatomy(liver).mesh.points
    way = np.linalg.norm(liver.motions[1].ground(points).shift(points), axis=1)
    below = points[:, 2].max() - points[:, 2]
    centre = liver.motions[1].ground(points).centre
    assert way[np.linalg.norm(points - centre, axis=1) > heartbeat.cranial_reach].max() == 0.0 < way[below < 0.01].max()
    assert below[way.argmax()] < 0.1 * np.ptp(below)


# ---- a surface that moves --------------------------------------------------------------------------------------------

LONG = CyclicMotion("breathing", (0.004, 0.0, 0.0015), period=(4.0, 4.0), rise=0.4, fall=0.4)


@pytest.fixture(scope="module")
def breathing():
    return load_anatomy(replace(make_scene("phantom_small"), name="long_breath", motions=(LONG,)))


@pytest.fixture(scope="module")
def still():
    return load_anatomy(make_scene("phantom_small"))


def test_an_organ_rests_on_its_moving_ground(breathing):
    """Put there or brought there: the same place within 1 % of the way, without a jump of what is held."""
    brought, put = Simulation(breathing), Simulation(breathing)
    for simulation in (brought, put):
        simulation.draw_motion(np.random.default_rng(3))
    delay = float(brought.drive.delay[0])
    elapsed = round(delay + 0.8, 3)
    for _ in range(round(elapsed / 1e-3)):
        assert brought.haptic_step()
    put.restart(put.instrument.parked, elapsed=elapsed)
    for _ in range(2):
        way = np.linalg.norm(brought.ground_shift(np.zeros(3)))
        assert way > 1e-3
        apart = brought.organ_state.node_position - put.organ_state.node_position
        assert np.abs(apart).max() < 0.01 * way
        for _ in range(100):
            assert brought.haptic_step() and put.haptic_step()
        assert put.motion_time == pytest.approx(brought.motion_time)


def test_a_press_goes_with_the_surface(breathing, still):
    """Force and depth of a tracked press as on an organ that holds still; one that does not track misses in depth."""
    site, normal = still.face.project(np.array([0.020, 0.020, 0.020]))
    scene = still.scene
    forces, depths = [], []
    for anatomy, elapsed, tracks in ((still, 0.0, True), (breathing, 0.8, True), (breathing, 0.8, False)):
        simulation = Simulation(anatomy)
        simulation.draw_motion(np.random.default_rng(3))
        elapsed += float(simulation.drive.delay[0]) if anatomy is breathing else 0.0
        result = press_alone(SitePress(simulation, site, normal, elapsed=elapsed, tracks=tracks), press_phases(scene))
        assert not result.fault
        forces.append(float(result.force @ normal))
        depths.append(result.depth)
    assert depths[1] == pytest.approx(depths[0], rel=0.05) and forces[1] == pytest.approx(forces[0], rel=0.08)
    # The surface has risen by a good millimetre below the tip that does not go with it.
    assert depths[2] > depths[0] + 0.0008 and forces[2] > 1.2 * forces[0]


def test_markers_foretell_an_even_motion(breathing):
    """The nodes are moved by hand: what is seen is late, what is foretold is not."""
    simulation = Simulation(breathing)
    nodes = np.unique(breathing.face.triangles)
    velocity = np.array([0.003, 0.0, -0.001])
    simulation.organ_state.node_velocity[:] = velocity
    tracker, rest = SurfaceTracker(simulation, nodes), simulation.organ_state.node_position.copy()
    for step in range(1, 6):
        simulation._step = 50 * step
        # A tool that presses a tenth of the markers does not change what is seen.
        simulation.organ_state.node_position[:] = rest + simulation.time * velocity
        simulation.organ_state.node_position[nodes[: len(nodes) // 10], 2] -= 0.005
        tracker.look()
        expected = (simulation.time + FRAME_DELAY) * velocity
        np.testing.assert_allclose(tracker.displacement(FRAME_DELAY), expected, atol=1e-4 * np.linalg.norm(velocity))


def test_a_tracked_step_goes_with_the_surface(scene_file):
    """While it holds, the tip stays over the tissue; without tracking it stays where it is."""
    ways = []
    for tracks in (True, False):
        env = gym.make("SurgSim/Palpate-v0", scene="phantom_small", motion="calm")
        env.reset(seed=5)
        inner = env.unwrapped
        inner.simulation.drive = inner.simulation.drive._replace(delay=np.zeros(2))
        tracker = SurfaceTracker(inner.simulation, np.unique(inner.simulation.anatomy.face.triangles))
        run = run_script(env, [Tracked(Hold(1.5), tracker) if tracks else Hold(1.5)])
        moved = run.tip_position[-1] - run.tip_position[0]
        ways.append(np.linalg.norm(moved - inner.simulation.ground_shift(np.array([0.02, 0.02, 0.02]))))
        assert np.linalg.norm(inner.simulation.ground_shift(np.zeros(3))) > 0.003
    assert ways[0] < 0.0006 and ways[1] > 0.003


def test_a_target_lies_on_its_bed_that_moves():
    """The target that the endoscope and pictures show goes with the bed; observed is its place at rest."""
    env = gym.make("SurgSim/Retract-v0", motion="free", scaled=False).unwrapped
    env.reset(seed=2)
    place = env.task.target.centre.copy()
    env.simulation.drive = env.simulation.drive._replace(delay=np.zeros(2))
    for _ in range(16):
        observation, *_ = env.step(np.zeros(env.action_space.shape))
    shift = env.simulation.ground_shift(place)
    assert np.linalg.norm(shift) > 0.002
    np.testing.assert_allclose(env._shown().target.centre, place + shift)
    np.testing.assert_allclose(observation[env.observation_slices["target_place"]], place[:2], atol=1e-6)


@pytest.mark.slow
def test_oracles_that_track_succeed_on_a_calm_patient():
    """`surgsim evaluate --motion calm` has 100 episodes of each."""
    for env_id, scene in (("Palpate", "phantom"), ("Retract", None)):
        env = gym.make(f"SurgSim/{env_id}-v0", scene=scene, motion="calm")
        for seed in range(5):
            env.reset(seed=seed)
            last = run_script(env, oracle_script(env, tracks=True)).infos[-1]
            assert last["success"] and not last["hard_limit"]


@pytest.mark.parametrize(
    ("env_id", "instrument"), [("Retract", None), ("Retract", "psm_retractor"), ("BimanualRetract", None)]
)
def test_tools_meet_supports_where_these_have_moved(env_id, instrument):
    """MuJoCo's bed, which tools touch and pictures show, is where the organ's is, to the way of a control step."""
    env = gym.make(f"SurgSim/{env_id}-v0", motion="free", instrument=instrument).unwrapped
    env.reset(seed=2)
    simulation = env.simulation
    bed = simulation.instrument.model.geom("support_bed").id
    at_rest = np.array(simulation.anatomy.scene.supports[0].position)
    simulation.instrument.refresh()
    np.testing.assert_allclose(simulation.instrument.data.geom_xpos[bed], at_rest, atol=1e-12)
    simulation.drive = simulation.drive._replace(delay=np.zeros(2))
    for _ in range(16):
        before = simulation.ground_shift(at_rest)
        env.step(np.zeros(env.action_space.shape))
    assert np.linalg.norm(before) > 0.002
    np.testing.assert_allclose(simulation.instrument.data.geom_xpos[bed], at_rest + before, atol=1e-9)
