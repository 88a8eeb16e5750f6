"""An arm as a scene's instrument: it follows lines, holds still in contact, feels loads, says what it cannot."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.arm.arm_instrument import ArmInstrument, check_port_outside, default_port
from surgsim_env.palpation.site_press import press
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene, with_instrument
from surgsim_env.scene.model import Port

ARMS = ["psm_palpator", "six_axis"]
ABOVE = np.array([0.03, 0.03, 0.058])  # over the phantom, in the air
DOWN = np.array([0.0, 0.0, -1.0])


def phantom(name, **changes):
    return load_anatomy(replace(with_instrument(make_scene("phantom"), name), **changes))


def made(name):
    anatomy = phantom(name)
    points = anatomy.mesh.points
    return ArmInstrument(anatomy, points.min(axis=0) - 0.048, points.max(axis=0) + 0.048)


@pytest.fixture(scope="module", params=ARMS)
def simulation(request):
    return Simulation(phantom(request.param))


@pytest.fixture(scope="module", params=ARMS)
def instrument(request):
    return made(request.param)


def let_run(instrument, count):
    """Haptic steps in the air, as the exchange makes them, with the joint positions after each."""
    for _ in range(count):
        mujoco.mj_step1(instrument.model, instrument.data)
        instrument.drive()
        mujoco.mj_step2(instrument.model, instrument.data)
        instrument.refresh()
        yield


def test_the_port_is_where_port_rules_want_it():
    """10 to 15 cm from the middle of the face, 6 to 10 cm beside the line of sight, out of the organ, facing it."""
    for name in ("phantom", "liver"):
        anatomy = load_anatomy(make_scene(name))
        port = default_port(anatomy.face)
        middle = np.array(port.point) + 0.13 * np.array(port.into)
        assert np.linalg.norm(port.into) == pytest.approx(1.0)
        assert anatomy.face.approach @ port.into == pytest.approx(np.cos(np.radians(30.0)))
        assert 0.06 < np.linalg.norm(np.cross(middle - port.point, anatomy.face.approach)) < 0.10
        assert np.linalg.norm(middle - anatomy.face.project(middle)[0]) < 0.02
        check_port_outside(port, anatomy)
        x, y, z = anatomy.mesh.points[anatomy.mesh.tets[0]].mean(axis=0).tolist()
        with pytest.raises(ValueError, match="lies inside the organ"):
            check_port_outside(replace(port, point=(x, y, z)), anatomy)


def test_a_port_inside_the_organ_is_refused():
    with pytest.raises(ValueError, match=r"\(30\.0, 30\.0, 15\.0\) mm"):
        Simulation(phantom("psm_palpator", port=Port((0.03, 0.03, 0.015))))


def test_a_port_out_of_reach_is_refused():
    with pytest.raises(ValueError, match="port"):
        Simulation(phantom("psm_palpator", port=Port((0.03, 0.03, 0.4))))


def test_a_port_of_the_scene_is_taken():
    simulation = Simulation(phantom("psm_palpator", port=Port((0.03, 0.03, 0.15), (0.0, 0.0, -1.0), 0.5)))
    arm = simulation.instrument.arm  # type: ignore[attr-defined]
    assert arm.port.point == (0.03, 0.03, 0.15)
    assert arm.trocar_residual(arm.home) < 1e-12


DIRECTIONS = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, -0.8, 0.0), (-0.6, 0.3, 0.2)]


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_tip_follows_a_line_of_20_mm_per_second_within_0p2_mm(instrument, direction):
    """Across the line at every haptic step of 30 mm, start included; along it the servo may lag by 0.2 mm."""
    along = np.array(direction) / np.linalg.norm(direction)
    start = ABOVE - 0.015 * along
    instrument.place(start)
    off, lag, residual = [], [], []
    for step in range(30):
        instrument.command_velocity(0.02 * along)
        for tick, _ in enumerate(let_run(instrument, 50)):
            away = instrument.tip_position - start
            off.append(np.linalg.norm(away - (away @ along) * along))
            lag.append(abs(0.02e-3 * (50 * step + tick + 1) - away @ along))
            residual.append(instrument.trocar_residual)
    print(f"\n{instrument.arm.description.name}: off {max(off) * 1e3:.4f} mm, lag {max(lag) * 1e3:.4f} mm, "
          f"trocar {max(residual) * 1e3:.2e} mm")  # fmt: skip
    assert not instrument.workspace_limited
    assert max(off) < 0.0002 and max(lag) < 0.0002
    assert max(residual) < (1e-9 if instrument.arm.remote_centre_fixed else 0.0003)


def test_the_tip_of_the_psm_keeps_its_direction():
    instrument = made("psm_palpator")
    instrument.place(ABOVE)
    for _ in range(20):
        instrument.command_velocity(np.array([0.014, -0.014, 0.0]))
        for _ in let_run(instrument, 50):
            pass
    assert instrument.arm.tip_direction(instrument.steered.joint_positions) == pytest.approx(DOWN, abs=2e-3)


def test_the_tip_turns_at_the_rate_it_is_told():
    """0.4 rad/s about y for 1 s, the place held: the direction is that of 0.4 rad, sin and cos."""
    instrument = made("psm_palpator")
    instrument.place(ABOVE)
    for _ in range(20):
        instrument.command_velocity(np.zeros(3), np.array([0.0, 0.4, 0.0]))
        for _ in let_run(instrument, 50):
            pass
    instrument.command_velocity(np.zeros(3))
    for _ in let_run(instrument, 200):
        pass
    assert instrument.tip_position == pytest.approx(ABOVE, abs=5e-5)
    expected = np.array([-np.sin(0.4), 0.0, -np.cos(0.4)])
    assert instrument.arm.tip_direction(instrument.steered.joint_positions) == pytest.approx(expected, abs=1e-3)


def test_it_presses_and_holds_still(simulation):
    """Pressed 4.5 mm into the phantom, after a second nothing moves; the servo gives way by less than 0.1 mm."""
    instrument = simulation.instrument
    simulation.restart(np.array([0.03, 0.03, 0.0385]))
    for _ in range(9):
        instrument.command_velocity(0.01 * DOWN)
        simulation.control_step(50)
    instrument.command_velocity(np.zeros(3))
    for _ in range(20):
        simulation.control_step(50)
    assert simulation.end_control_step(), simulation.fault
    assert 0.2 < simulation.contact_force[2] < 0.3
    assert np.linalg.norm(instrument.tip_velocity) < 1e-6
    assert instrument.tip_position == pytest.approx([0.03, 0.03, 0.034], abs=1e-4)


@pytest.mark.parametrize("name", ARMS)
def test_a_press_of_the_scan_feels_what_the_probe_feels(name):
    """The same ball, the same path: forces differ by what the servos give way, 0.1 mm of 4 at most."""
    forces, depths = [], []
    for instrument in ("probe", name):
        anatomy = phantom(instrument)
        simulation = Simulation(anatomy)
        result = press(simulation, np.array([0.025, 0.03, 0.03]), np.array([0.0, 0.0, 1.0]))
        assert not result.end
        forces.append(result.force)
        depths.append(result.depth)
    assert depths[1] == pytest.approx(depths[0], abs=1e-4)
    assert forces[1] == pytest.approx(forces[0], rel=0.04)


def test_a_load_bends_the_servo_and_not_the_path(instrument):
    """3 N across while the tip moves 10 mm: it gives way, and comes back onto its line when the load goes."""
    instrument.place(ABOVE)
    body = instrument.model.site_bodyid[instrument.arm.tip_site]
    for _ in range(20):
        instrument.data.xfrc_applied[body, 1] = 3.0
        instrument.command_velocity(np.array([0.01, 0.0, 0.0]))
        for _ in let_run(instrument, 50):
            pass
    assert instrument.tip_position[1] - ABOVE[1] > 3e-5
    instrument.data.xfrc_applied[body] = 0.0
    instrument.command_velocity(np.zeros(3))
    for _ in let_run(instrument, 500):
        pass
    assert instrument.tip_position == pytest.approx(np.add(ABOVE, [0.01, 0.0, 0.0]), abs=1e-7)


def test_gravity_is_compensated(instrument):
    """Without a servo's help the arm at rest stays where it is."""
    instrument.place(ABOVE)
    assert np.linalg.norm(instrument.model.opt.gravity) == pytest.approx(9.81)
    assert np.abs(instrument.data.qacc).max() < 1e-9
    before = instrument.steered.joint_positions.copy()
    for _ in let_run(instrument, 200):
        pass
    assert np.abs(instrument.steered.joint_positions - before).max() < 1e-9


def test_the_box_stops_the_tip_and_says_so(instrument):
    instrument.place(ABOVE)
    for _ in range(30):
        instrument.command_velocity(np.array([0.0, 0.0, 0.02]))
        for _ in let_run(instrument, 50):
            pass
    assert instrument.workspace_limited
    assert instrument.tip_position[2] == pytest.approx(instrument.upper[2], abs=1e-4)
    saved = instrument.get_state()
    instrument.command_velocity(np.array([0.0, 0.0, -0.02]))
    assert not instrument.workspace_limited
    instrument.set_state(saved)
    assert instrument.workspace_limited


def test_a_joints_limit_stops_the_tip_and_says_so():
    """The port 20 cm above the phantom's face: along the shaft the insertion ends before the tray."""
    anatomy = phantom("psm_palpator", port=Port((0.03, 0.03, 0.275)))
    instrument = ArmInstrument(anatomy, np.full(3, -0.5), np.full(3, 0.5))
    instrument.place(ABOVE)
    for _ in range(60):
        instrument.command_velocity(np.array([0.0, 0.0, -0.02]))
        for _ in let_run(instrument, 50):
            pass
    assert instrument.workspace_limited
    arm = instrument.arm
    insertion = instrument.steered.joint_positions[arm.joints.index("insertion")]
    assert 0.238 < insertion < 0.2401
    assert instrument.tip_position[:2] == pytest.approx(ABOVE[:2], abs=1e-5)


def test_an_unreachable_place_is_refused_with_the_distance(instrument):
    with pytest.raises(ValueError, match=r"\(5000\.0, .* \d+\.\d+ mm"):
        instrument.place(np.array([5.0, 0.0, 0.0]))


def test_the_jaw_goes_to_its_target_and_stays_there():
    """-1 to 1 is -20 to 40 degrees of each finger, in half a second; without pads it starts as when loaded."""
    grasper = made("psm_grasper")
    grasper.place(ABOVE)
    assert grasper.jaw.opening < 0.002
    grasper.command_jaw(0.5)
    least, most = np.radians([-20.0, 40.0])
    rate, reached = (most - least) / 0.5, least + 0.75 * (most - least)
    for step, _ in enumerate(let_run(grasper, 500), start=1):
        targets = grasper.data.ctrl[grasper.servo.position[6:]]
        assert targets == pytest.approx(np.full(2, min(step * 0.001 * rate, reached)), abs=1e-12)
        assert not grasper.workspace_limited
    assert grasper.jaw.target == pytest.approx(0.5)
    angles = [grasper.data.joint(name).qpos[0] for name in ("finger_left", "finger_right")]
    assert angles == pytest.approx([reached, reached], abs=1e-3)
    with pytest.raises(ValueError, match=r"jaw target 2 is out of range: it goes from -1 \(closed\) to 1 \(open\)"):
        grasper.command_jaw(2.0)
    with pytest.raises(ValueError, match="has no jaw to command"):
        made("psm_palpator").command_jaw(0.1)
