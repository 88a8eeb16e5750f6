"""The press beside other simulators: force out of MuJoCo, what diverges or is absent, the search for flex's step."""

from dataclasses import dataclass

import mujoco
import numpy as np
import pytest

from surgsim_env.bench import peers, side_by_side
from surgsim_env.bench.peers import Flex, Newton, contact_force, fastest_within
from surgsim_env.bench.presses import DEPTH, Contender, DivergedError, Pressed, ball_height, step_count
from surgsim_env.bench.report import AbsentError

BALL = """<mujoco><option gravity="0 0 -9.81" timestep="0.001"/><worldbody><geom type="plane" size="1 1 1"/>
<body pos="0 0 0.01"><freejoint/><geom type="sphere" size="0.01" mass="0.2"/></body></worldbody></mujoco>"""


def test_contact_force_is_the_weight_of_what_rests():
    model = mujoco.MjModel.from_xml_string(BALL)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    # m g; which way depends on which geom comes first.
    assert abs(contact_force(model, data)[2]) == pytest.approx(0.2 * 9.81, rel=1e-3)


def test_the_press_ends_at_its_depth():
    assert ball_height(0.05) == pytest.approx(-0.5 * DEPTH)
    assert ball_height(step_count(1e-3) * 1e-3) == -DEPTH
    assert step_count(1e-3) == 200


def test_flex_presses_and_pushes_back():
    grid = (5, 5, 3)
    trilinear = Flex(grid, trilinear=(1, 1, 1)).contender().press(0.0)
    full = Flex(grid).contender().press(0.0)
    assert full.simulated == pytest.approx(0.2)
    # One trilinear cell cannot dent: it answers as a whole.
    assert trilinear.force > 2.0 * full.force > 0.2


def test_too_long_a_step_is_said_to_diverge():
    with pytest.raises(DivergedError, match="mjWARN"):
        Flex((5, 5, 3), "Euler", 5e-3, 0.005).contender().press(0.0)


@dataclass(frozen=True)
class Timed:
    """Stands for Flex: longer steps are faster, up to 4 ms; the force falls with them; 8 ms diverges."""

    dt: float = 1e-3
    iterations: int = 100

    def contender(self) -> Contender:
        def press(offset: float) -> Pressed:
            if self.dt > 7e-3:
                raise DivergedError("no")
            return Pressed(1.0 - 5.0 * self.dt, 0.0, 1e-3 / min(self.dt, 4e-3), 0.2)

        return Contender("timed", "", "", press)


def test_fastest_step_keeps_its_force():
    best, tried = fastest_within(Timed(), 1.0, (2, 3, 4, 5, 8), 0.02)  # type: ignore[type-var]
    # 4 ms is off by exactly 2 %, give or take rounding; 5 ms by 2.5 %.
    assert best is not None and best.dt in (3e-3, 4e-3)
    assert tried[3] == "5 ms: force -2.5 %" and tried[4] == "8 ms: no"
    assert fastest_within(Timed(), 2.0, (2, 3), 0.02)[0] is None  # type: ignore[type-var]


def test_newton_that_is_not_installed_is_absent(monkeypatch):
    def missing(name: str):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(peers, "import_module", missing)
    with pytest.raises(AbsentError, match=r"not installed.*surgsim\[bench\]"):
        Newton((5, 5, 3), "vbd", 1e-3).contender()


def test_newton_where_it_is_installed():
    pytest.importorskip("newton", reason="newton is optional: pip install 'surgsim[bench]'")
    pressed = Newton((5, 5, 3), "explicit", 4e-4).contender().press(0.0)
    assert 0.1 < pressed.force < 1.0


def test_a_peer_that_diverges_is_named_with_its_setting(monkeypatch):
    def fail(offset: float) -> Pressed:
        raise DivergedError("blew up")

    monkeypatch.setattr(side_by_side, "reference_force", lambda contact: 0.2)
    own = side_by_side.Tally(Contender("own", "set", "1 node", lambda offset: Pressed(0.3, 2.0, 1.0, 1.0)))
    peer = side_by_side.Tally(Contender("peer", "5 ms", "1 node", fail))
    own.press()
    peer.press()
    (figure,) = side_by_side._figures(peer, own)
    assert figure.value is None and "diverged: blew up" in figure.note and "5 ms" in figure.note
    by_name = {figure.quantity: figure.value for figure in side_by_side._figures(own, own)}
    assert by_name["wall"] == 2.0 and by_name["ratio to surgsim"] == 1.0
    if "error" in by_name:
        assert by_name["error"] == pytest.approx(50.0)


def test_a_tet_inside_out_is_a_fault():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert peers._fault(points, np.array([[0, 1, 2, 3]])) == ""
    assert peers._fault(points, np.array([[0, 1, 2, 3], [0, 2, 1, 3]])) == "1 tets inside out"
    assert peers._fault(points * np.nan, np.array([[0, 1, 2, 3]])) == "positions are not finite"
