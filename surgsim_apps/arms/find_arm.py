"""A palpating arm from a model file alone: chain, tip, shaft, trocar, servos and a home within reach.

The arm's own frame is the model file's. An arm with a remote centre has its trocar there; for any other arm a trocar is
chosen together with home, or home is searched for a given trocar.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import mujoco
import numpy as np

from msdm_core.arithmetic import cos, matmul, norm, sin, svd
from msdm_core.mesh import FloatArray
from surgsim_apps.arms.survey import (
    SLIDE,
    SPHERE,
    Capsule,
    ModelSurvey,
    RemoteCentre,
    fit_capsule,
    is_shaft,
    meeting_point,
    vector,
)
from surgsim_env.instruments import (
    Arm,
    compile_arm,
    joint_law,
    position_actuator,
    solve_pose,
)
from surgsim_env.scene import AddedShape, ArmDescription, JointControl, Port, Tip, Trocar, Vector, tangent_axes

# A palpator's dimensions [m]: an 8 mm shaft, a thinner neck behind the ball, whose radius a scene sets.
SHAFT_RADIUS, NECK_RADIUS, NECK_LENGTH, BALL_RADIUS = 0.004, 0.003, 0.024, 0.005
# Length of a palpator that is mounted on an arm without a straight shaft [m].
TOOL_LENGTH = 0.40
# Depth of the tip past the trocar at home [m]; with a remote centre that far at least from the ends of the insertion.
HOME_DEPTH, HOME_MARGIN = 0.10, 0.04
# Servos, chosen: natural frequency of each joint [rad/s] and its smallest stiffness at the tip [N/m]: 5 N move it by
# 0.1 mm.
NATURAL_FREQUENCY, TIP_STIFFNESS = 2.0 * math.pi * 30.0, 5e4
# A joint's smallest lever to the tip for that stiffness [m], and the force at the tip that its servo can exert [N].
LEVER_LEAST, TIP_FORCE = 0.02, 50.0
# Speed limits for a model without them [rad/s], [m/s]; range of joints without limits [rad], [m].
TURN_SPEED, SLIDE_SPEED = 2.0, 0.4
TURN_RANGE, SLIDE_RANGE = 2.0 * math.pi, 0.5
# Places for judging a home: depths from its own [m], straight on and tilted by an angle [rad] to four sides.
DEPTHS, TILT = (-HOME_MARGIN, 0.0, HOME_MARGIN), math.radians(25.0)
# Poses drawn at random, and number of the best to be tried.
POSES_DRAWN, POSES_TRIED = 3000, 20
# Tolerances of the trocar [m]: with a remote centre the file's rounding, else what control keeps at home.
FIXED_TOLERANCE, KEPT_TOLERANCE = 1e-4, 1e-5
# Parts up to this size are no outer links [m].
SMALL_PART = 0.04
ONE_MM = 1e-3
FREE = int(mujoco.mjtJoint.mjJNT_FREE)


@dataclass(frozen=True)
class FoundArm:
    """An arm found in a model file.

    Fields:
        description: of the arm, for a folder with its TOML file
        notes: findings, a sentence each
        chosen: choices for things missing in the file, a sentence each
        reach: share of the places around home (DEPTHS, TILT) in reach of the tip
    """

    description: ArmDescription
    notes: list[str]
    chosen: list[str]
    reach: float


@dataclass(frozen=True)
class _Tool:
    """The straight shaft and the tip, each in its body's frame.

    Fields:
        tip_body, tip_offset, tip_direction: the tip [m] and the direction out of it   (3,)
        shaft_body, shaft_point, shaft_axis: a point of the shaft's axis [m] and its direction to the tip   (3,)
        shapes: capsules and a ball in contact with tissue
        contact: names of these or of the model's own
        ball: the ball's name
    """

    tip_body: int
    tip_offset: FloatArray
    tip_direction: FloatArray
    shaft_body: int
    shaft_point: FloatArray
    shaft_axis: FloatArray
    shapes: tuple[AddedShape, ...]
    contact: tuple[str, ...]
    ball: str


def find_arm(
    path: Path,
    *,
    tip: str | None = None,
    trocar: Vector | None = None,
    tool_length: float | None = None,
) -> FoundArm:
    """Make a palpating arm from an MJCF or URDF file.

    Args:
        path: of the file.
        tip: link or site of the tip, or carrier of a mounted tool; by default the end of the longest chain of joints.
        trocar: point of the trocar in the model's own frame [m]; by default the remote centre, or chosen with home.
        tool_length: mount a straight palpator of this length [m], even if the model has a shaft.

    Raises:
        ValueError: an unreadable file, an unknown tip, a trocar out of reach.
    """
    return _Finder(ModelSurvey(path), tip, trocar, tool_length).result


class _Finder:
    def __init__(self, survey: ModelSurvey, tip: str | None, trocar: Vector | None, tool_length: float | None) -> None:
        self.survey, self.model = survey, survey.model
        self.notes, self.chosen = [], []
        body, offset = survey.find_tip(tip)
        self.chain, self.centre = survey.chain(body), None
        if tool_length is None:
            self.chain, self.centre = survey.centred_chain(body, np.zeros(3) if offset is None else offset)
        self.moved, self.driven, self.followers = self.chain.joints, self.chain.driven, self.chain.followers
        self.names = [self.model.joint(joint).name for joint in self.driven]
        self.lower, self.upper = self._limits().T
        self.zero = np.clip(0.0, self.lower, self.upper)
        self._say_model(body)
        centre, self.depth = self.centre, HOME_DEPTH
        if centre is not None:
            least, most = centre.depths
            margin = min(HOME_MARGIN, 0.5 * (most - least))
            self.depth = round(min(max(HOME_DEPTH, least + margin), most - margin), 6)
        survey.place(self.chain, self.zero)
        self.tool = self._find_tool(body, offset, tool_length)
        self.links, link_shapes = self._find_links()
        self.trocar_given = None if trocar is None else np.array(trocar)
        if centre is not None and trocar is not None and norm(np.array(trocar) - centre.point) > ONE_MM:
            raise ValueError(
                f"--trocar is {trocar}, but the mechanism keeps its shaft at {vector(centre.point, 4)}: leave --trocar "
                "out"
            )
        arm = self._search_arm(link_shapes)
        home, point, into, reach = self._search_home(arm)
        self.result = self._finish(link_shapes, home, point, into, reach)

    # ---- findings in the file --------------------------------------------------------------------------------

    def _limits(self) -> FloatArray:
        """Limits of the driven joints (n, 2) [rad or m]."""
        stated, own = self.chain.limits, np.array([self.survey.range_of(joint, math.inf) for joint in self.driven])
        most = np.where(self.model.jnt_type[self.driven] == SLIDE, SLIDE_RANGE, TURN_RANGE)
        free = np.isinf(stated).any(axis=1)
        narrowed = ~free & (stated != own).any(axis=1)
        limits = np.where(np.isfinite(stated), stated, np.stack([-most, most], axis=1))
        written = free | narrowed | np.isin(self.names, list(self.survey.crossed))
        rows = zip(self.names, written, limits.round(9).tolist(), strict=True)
        self.given_limits = {name: (low, high) for name, new, (low, high) in rows if new}
        names = np.array(self.names)
        if narrowed.any():
            self.chosen.append(f"limits are narrowed to those of coupled joints: {', '.join(names[narrowed])}")
        if free.any():
            self.chosen.append(
                f"joints without limits ({', '.join(names[free])}) get one turn to either side, or -0.5 to 0.5 m"
            )
        return limits

    def _say_model(self, body: int) -> None:
        survey = self.survey
        self.notes.append(f"chain of {len(self.driven)} joints: {', '.join(self.names)}")
        for index, name in enumerate(self.names):
            led = self.followers.joints[self.followers.driver == index]
            names = [self.model.joint(joint).name for joint in led if joint in self.chain.moving]
            if names:
                self.notes.append(f"coupled to {name}: {', '.join(names)}")
        self.notes.append(f"its end: {survey.body_name(body)}")
        for fault, places in survey.left_out.items():
            self.chosen.append(f"shapes left out: {_listed(places)} ({fault})")
        if survey.crossed:
            pairs = [f"{name} {low:g} to {high:g}" for name, (low, high) in survey.crossed.items()]
            self.chosen.append(f"limits whose lower is above the upper one are used in order: {_listed(pairs)}")
        if survey.locked:
            values = [f"{name} at {value:g}" for name, value in survey.locked.items()]
            self.chosen.append(f"joints that cannot move by their limits or couplings are held: {_listed(values)}")
        if survey.inertias:
            self.chosen.append(
                "links without a valid inertia get that of a block around their shapes: "
                f"{_listed([inertia.link for inertia in survey.inertias])}"
            )

    @property
    def _last_name(self) -> str:
        return self.model.joint(self.moved[-1]).name

    # ---- shaft and tip ---------------------------------------------------------------------------------------

    def _world(self, body: int, local: FloatArray) -> FloatArray:
        return self.survey.data.xpos[body] + matmul(self.survey.data.xmat[body].reshape(3, 3), local)

    def _local(self, body: int, point: FloatArray) -> FloatArray:
        return matmul(self.survey.data.xmat[body].reshape(3, 3).T, point - self.survey.data.xpos[body])

    def _turned(self, body: int, direction: FloatArray) -> FloatArray:
        return matmul(self.survey.data.xmat[body].reshape(3, 3).T, direction)

    def _find_tool(self, body: int, offset: FloatArray | None, tool_length: float | None) -> _Tool:
        survey = self.survey
        if self.centre is not None:
            return self._jointed_tool(self.centre, body, offset)
        carriers = [part for part in survey.parents(body) if part in survey.shaft]
        if tool_length is None and carriers:
            return self._own_shaft(carriers[0], body, offset)
        return self._mounted_tool(body, offset, TOOL_LENGTH if tool_length is None else tool_length)

    def _jointed_tool(self, centre: RemoteCentre, body: int, offset: FloatArray | None) -> _Tool:
        """The shaft through a remote centre, the links of a wrist beyond it, and a ball at the tip."""
        point = vector(centre.point, 4)
        self.notes.append(f"remote centre at {point} m: the mechanism keeps the shaft there")
        if centre.missed > FIXED_TOLERANCE:
            self.chosen.append(
                f"by the model's lengths the shaft leaves its remote centre by up to {1e3 * centre.missed:.1f} mm"
            )
        along = matmul(self.survey.data.xmat[centre.body].reshape(3, 3), centre.shaft_axis)
        length = centre.depths[1] - centre.depths[0] + 0.05
        return self._wristed(centre.body, centre.shaft_point, centre.shaft_axis, along, body, offset, length)

    def _own_shaft(self, carrier: int, body: int, offset: FloatArray | None) -> _Tool:
        """A straight thin part of the model as the shaft."""
        part = self.survey.shaft[carrier]
        ends = [self._world(carrier, end) for end in (part.start, part.end)]
        near = self._world(body, offset) if offset is not None else self.survey.data.xpos[body]
        if body == carrier and offset is None:
            near = max(ends, key=lambda end: float(norm(end - self.survey.data.xpos[body])))
        start, end = sorted(ends, key=lambda point: -float(norm(point - near)))
        along = (end - start) / norm(end - start)
        name = self.survey.body_name(carrier)
        self.notes.append(
            f"straight shaft on {name}: {1e3 * part.length:.0f} mm long, {2e3 * part.radius:.1f} mm thick"
        )
        axis = self._turned(carrier, along)
        if body == carrier and offset is None:
            offset = self._local(body, end)
        length = float(norm(end - start))
        return self._wristed(carrier, self._local(carrier, start), axis, along, body, offset, length)

    def _wristed(
        self,
        shaft_body: int,
        point: FloatArray,
        axis: FloatArray,
        along: FloatArray,
        body: int,
        offset: FloatArray | None,
        length: float,
    ) -> _Tool:
        survey = self.survey
        beyond = [j for j in self.moved if shaft_body in survey.parents(int(self.model.jnt_bodyid[j]))[1:]]
        anchors = [survey.data.xanchor[joint].copy() for joint in beyond]
        bodies = [shaft_body, *(int(self.model.jnt_bodyid[joint]) for joint in beyond)]
        last = anchors[-1] if anchors else self._world(shaft_body, point)
        tip = self._tip_point(body, offset, last, along)
        offset = self._local(body, tip)
        own = self._own_contact(shaft_body, tip)
        on_axis = self._world(shaft_body, point)
        reach = [*anchors, tip]
        end = on_axis + matmul(reach[0] - on_axis, along) * along
        way = tip - last
        straight = not anchors or norm(way) < ONE_MM
        direction = along if straight else way / norm(way)
        if own:
            shapes, contact = (), own
        else:
            neck = min(NECK_LENGTH, 0.3 * length) if straight and not anchors else 0.0
            end = end - neck * along
            # The chain of capsules: the shaft, the links of the wrist, the neck up to the ball.
            corners = [end, *reach] if neck else [*reach]
            names = ["neck"] if not anchors else [*(f"wrist_{n}" for n in range(1, len(anchors))), "neck"]
            carriers = [shaft_body] if not anchors else bodies[1:]
            parts = [("shaft", shaft_body, end - (length - neck) * along, end, SHAFT_RADIUS)]
            for name, carrier, near, far in zip(names, carriers, corners, corners[1:], strict=False):
                if norm(far - near) >= ONE_MM:
                    parts.append((name, carrier, near, far, NECK_RADIUS))
            shapes = tuple(self._shape(*part) for part in parts)
            shapes = (AddedShape("tip_ball", survey.body_name(body), vector(offset), BALL_RADIUS), *shapes)
            contact = tuple(shape.name for shape in shapes)
            self.chosen.append(
                "tissue feels spheres and capsules: a ball at the tip and capsules along the tool are added"
            )
        return _Tool(body, offset, self._turned(body, direction), shaft_body, point, axis, shapes, contact, contact[0])

    def _tip_point(self, body: int, offset: FloatArray | None, last: FloatArray, along: FloatArray) -> FloatArray:
        """The tip: a frame marking it, else the farthest point of the last links from the last joint."""
        if offset is not None:
            return self._world(body, offset)
        survey = self.survey
        near = [part for part in range(1, self.model.nbody) if body in survey.parents(part)]
        clouds = [
            survey.data.xpos[part] + matmul(survey.body_points(part), survey.data.xmat[part].reshape(3, 3).T)
            for part in near
        ]
        points = np.concatenate(clouds)
        if not len(points):
            self.chosen.append(f"link {survey.body_name(body)!r} has no shape: its origin is the tip")
            return survey.data.xpos[body].copy()
        mean = points.mean(axis=0) - last
        out = mean / norm(mean) if norm(mean) > ONE_MM else along
        self.chosen.append(f"no frame marks the tip: it is the farthest point of the links beyond {self._last_name!r}")
        return last + max(float(matmul(points - last, out).max()), 0.0) * out

    def _own_contact(self, shaft_body: int, tip: FloatArray) -> tuple[str, ...]:
        """Names of the model's spheres and capsules from the tip to the shaft, if a sphere is at the tip."""
        model, survey = self.model, self.survey
        bodies = [part for part in range(1, model.nbody) if shaft_body in survey.parents(part)]
        geoms = [geom for part in bodies for geom in survey.round_geoms(part)]
        # The geom's place: the data hold no geoms before `mj_kinematics`, which `place` calls.
        far = {geom: float(norm(survey.data.geom_xpos[geom] - tip)) for geom in geoms}
        balls = [g for g in geoms if model.geom_type[g] == SPHERE and far[g] <= ONE_MM]
        if not balls:
            return ()
        others = sorted((geom for geom in geoms if geom != balls[0]), key=lambda geom: far[geom])
        return tuple(model.geom(geom).name for geom in (balls[0], *others))

    def _mounted_tool(self, body: int, offset: FloatArray | None, length: float) -> _Tool:
        """A straight palpator along the axis of the last hinge, from the outer face of the last link."""
        survey, joint = self.survey, self.moved[-1]
        anchor, axis = survey.data.xanchor[joint].copy(), survey.data.xaxis[joint].copy()
        link = int(self.model.jnt_bodyid[joint])
        cloud = survey.data.xpos[link] + matmul(survey.body_points(link), survey.data.xmat[link].reshape(3, 3).T)
        marked = self._world(body, offset) if offset is not None else None
        heights = matmul(cloud - anchor, axis)
        mark = 0.0 if marked is None else float(matmul(marked - anchor, axis))
        if abs(mark) > ONE_MM:
            side = np.sign(mark)
        elif len(heights):
            side = np.sign(heights[np.argmax(np.abs(heights))])
        else:
            side = 1.0
        face = max([side * mark, *(side * heights)])
        along = side * axis
        start = anchor + face * along
        tip, end = start + length * along, start + (length - NECK_LENGTH) * along
        shapes = (
            AddedShape("tip_ball", survey.body_name(body), vector(self._local(body, tip)), BALL_RADIUS),
            self._shape("neck", body, end, tip, NECK_RADIUS),
            self._shape("shaft", body, start, end, SHAFT_RADIUS),
        )
        self.chosen.append(
            f"the model has no straight shaft (at least 100 mm long, at most 16 mm thick): a palpator "
            f"{1e3 * length:.0f} mm long is mounted on {survey.body_name(body)!r} along the axis of {self._last_name!r}"
        )
        direction = self._turned(body, along)
        contact = tuple(shape.name for shape in shapes)
        return _Tool(
            body,
            self._local(body, tip),
            direction,
            body,
            self._local(body, start),
            direction,
            shapes,
            contact,
            contact[0],
        )

    def _shape(self, name: str, body: int, start: FloatArray, end: FloatArray, radius: float) -> AddedShape:
        carrier = self.survey.body_name(body)
        return AddedShape(name, carrier, vector(self._local(body, start)), radius, vector(self._local(body, end)))

    # ---- outer shapes ----------------------------------------------------------------------------------------

    def _find_links(self) -> tuple[tuple[str, ...], tuple[AddedShape, ...]]:
        """Outer shapes of the bodies before the tool: the model's named ones, else a capsule around all of a body."""
        survey, names, shapes = self.survey, [], []
        carrier = self.tool.shaft_body if self.centre is None else int(self.model.jnt_bodyid[self.centre.joint])
        for body in range(1, self.model.nbody):
            beyond = carrier in survey.parents(body)
            own = [self.model.geom(geom).name for geom in survey.round_geoms(body)]
            own = [name for name in own if name not in self.tool.contact]
            if own:
                names.extend(own)
                continue
            clouds = [survey.geom_points(geom) for geom in survey.body_geoms(body)]
            # Small parts are markers and jaws; a thin part on what carries the shaft, or beyond, is the shaft.
            clouds = [cloud for cloud in clouds if len(cloud) and float(np.ptp(cloud, axis=0).max()) > SMALL_PART]
            clouds = [cloud for cloud in clouds if not (beyond and is_shaft(fit_capsule(cloud)))]
            if not clouds:
                continue
            fitted = fit_capsule(np.concatenate(clouds))
            name = f"link_{survey.body_name(body)}"
            names.append(name)
            shapes.append(_added(name, survey.body_name(body), fitted))
        if shapes:
            self.chosen.append("outer links, for clearances only: a capsule around each link that has a shape")
        return tuple(names), tuple(shapes)

    # ---- home ------------------------------------------------------------------------------------------------

    def _search_arm(self, link_shapes: tuple[AddedShape, ...]) -> Arm:
        """The arm in its model's own frame, with provisional servos, home and trocar."""
        control = JointControl("servo", *(tuple(1.0 for _ in self.names) for _ in range(4)))
        control = replace(control, speed_limit=self._speed_limits())
        description = self._description(link_shapes, control, self.zero, np.zeros(3), np.array([0.0, 0.0, -1.0]))
        arm = Arm(description, Port(), compile_arm(description, Port(), None, 0.001))
        if self.centre is not None:
            arm.trocar = self.centre.point
        return arm

    def _search_home(self, arm: Arm) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Home, trocar, direction into the body and reach, of the tried pose with the largest reach."""
        best = None
        starts = self._good_starts(arm) if self.centre is None else self._starts_about(self.centre)
        places = [(start, place) for start in starts for place in self._trocars(arm, start)]
        for start, place in places:
            arm.trocar = place
            into = arm.shaft_line(start)[1]
            home = self._at_depth(arm, place, into, start)
            into = into if home is None else arm.shaft_line(home)[1]
            # The mechanism of a remote centre holds its tool by links about it.
            if home is None or (self.centre is None and self._blocked(arm, home)):
                continue
            share = reach_share(arm, home, into, self.depth)
            if best is None or share > best[3] + 1e-9:
                best = home, arm.trocar.copy(), into, share
            if share == 1.0:
                break
        if best is None:
            what = "the trocar" if self.trocar_given is None else f"the trocar at {vector(self.trocar_given, 4)}"
            raise ValueError(
                f"model file {self.survey.path}: no pose was found with the shaft in {what}, the tip "
                f"{1e3 * self.depth:.0f} mm past it and the tool outside other links: move it with --trocar, or name "
                "another --tip"
            )
        return best

    def _trocars(self, arm: Arm, start: FloatArray) -> list[FloatArray]:
        """Trocars to be tried from a pose: the shaft's crossing with the first axis, and HOME_DEPTH from the tip.

        An arm with few joints turns its shaft only about a point of its first axis: such as the linkage of a remote
        centre, which is open in a URDF.
        """
        if self.centre is not None:
            return [self.centre.point]
        if self.trocar_given is not None:
            return [self.trocar_given]
        point, into = arm.shaft_line(start)
        tip = arm.tip_pose(start).position
        self.survey.place(self.chain, start)
        anchor, axis = self.survey.data.xanchor[self.moved[0]], self.survey.data.xaxis[self.moved[0]]
        crossing = meeting_point(np.stack([point, anchor]), np.stack([into, axis]))
        behind = point + (matmul(tip - point, into) - HOME_DEPTH) * into
        return [behind] if crossing is None else [crossing, behind]

    def _at_depth(self, arm: Arm, trocar: FloatArray, into: FloatArray, start: FloatArray) -> FloatArray | None:
        """Joint values near a start with the tip at its depth past the trocar, pointing along the shaft if it can."""
        place = trocar + self.depth * into
        for direction in (into, None):
            pose = solve_pose(arm, place, direction=direction, start=start)
            if max(pose.position_error, pose.trocar_error) < 1e-6 and (direction is None or pose.reached):
                return pose.joints
        return None

    def _starts_about(self, centre: RemoteCentre) -> list[FloatArray]:
        """Poses with different joints that turn the shaft about a remote centre."""
        before = np.isin(np.arange(len(self.driven)), list(centre.turning))
        draws = np.random.default_rng(0).uniform(self.lower, self.upper, (POSES_TRIED, len(self.driven)))
        return [np.where(before, pose, self.zero) for pose in (self.zero, 0.5 * (self.lower + self.upper), *draws)]

    def _good_starts(self, arm: Arm) -> list[FloatArray]:
        """Poses with the tool pointing down, away from limits and singular poses, the best first; keyframes before."""
        own = [self.model.key_qpos[key][self.model.jnt_qposadr[self.driven]] for key in range(self.model.nkey)]
        own = [key.clip(self.lower, self.upper) for key in own]
        lower, upper = np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)
        draws = np.random.default_rng(0).uniform(lower, upper, (POSES_DRAWN, len(self.driven)))
        worth = np.array([self._worth(arm, pose) for pose in draws])
        order = np.argsort(-worth)[:POSES_TRIED]
        return [*own, self.zero, *draws[order]]

    def _worth(self, arm: Arm, pose: FloatArray) -> float:
        margin = np.minimum(pose - self.lower, self.upper - pose) / (self.upper - self.lower)
        jacobian = arm.tip_jacobian(pose)
        least = float(svd(jacobian[:3])[1][-1])
        return (1.0 - arm.tip_direction(pose)[2]) * min(float(margin.min()) / 0.1, 1.0) * least

    def _blocked(self, arm: Arm, joints: FloatArray) -> bool:
        """True if the tool passes through a link other than its carrier, those beyond or the two before it."""
        survey, end = self.survey, int(self.model.jnt_bodyid[self.moved[-1]])
        # Frames fixed to a link count with it, and so do the fingers of a hand that holds the tool.
        parents = survey.parents(self.tool.shaft_body)
        last = [*(part for part in parents if survey.body_joints(part)), parents[-1]][:3][-1]
        near = {*parents[: parents.index(last) + 1]}
        near |= {part for part in range(1, self.model.nbody) if end in survey.parents(part)}
        carriers = {survey.body_name(part) for part in near}
        model, data = arm.model, mujoco.MjData(arm.model)
        arm.write(data, joints)
        mujoco.mj_kinematics(model, data)
        links = [geom for geom in arm.shapes[~arm.felt] if model.body(model.geom_bodyid[geom]).name not in carriers]
        return any(
            mujoco.mj_geomDistance(model, data, tool, link, ONE_MM, None) < 0.0
            for tool, link in product(arm.shapes[arm.felt], links)
        )

    # ---- control and the whole -------------------------------------------------------------------------------

    def _speed_limits(self) -> tuple[float, ...]:
        stated = self.survey.speed_limits
        slides = self.model.jnt_type[self.driven] == SLIDE
        default = np.where(slides, SLIDE_SPEED, TURN_SPEED)
        speed = np.array([stated.get(name, value) for name, value in zip(self.names, default, strict=True)])
        for joint, driver, slope, _ in zip(*self.followers, strict=True):
            speed[driver] = min(speed[driver], stated.get(self.model.joint(joint).name, math.inf) / abs(slope))
        return tuple(speed.tolist())

    def _control(self, arm: Arm, home: FloatArray) -> JointControl:
        """The model's own position actuators, if each joint has a usable one, else servos for these joints."""
        speed = self._speed_limits()
        model = self.model
        actuators = [position_actuator(model, name) for name in self.names]
        if all(a >= 0 and self._covers(a, index) for index, a in enumerate(actuators)):
            self.notes.append("driven by the model's own position actuators")
            return JointControl("position", speed)
        if model.nu:
            self.chosen.append(
                "the model has no position actuator over the whole range of each joint: servos replace its actuators"
            )
        else:
            self.chosen.append("the model has no actuators: servos are added")
        inertia, own = joint_inertia(arm, home), model.dof_armature[model.jnt_dofadr[self.driven]]
        lever = norm(arm.tip_jacobian(home)[:3], axis=0)
        slides = model.jnt_type[self.driven] == SLIDE
        lever = np.where(slides, 1.0, np.maximum(lever, LEVER_LEAST))
        least = TIP_STIFFNESS * (lever * lever) / (NATURAL_FREQUENCY * NATURAL_FREQUENCY)
        armature = np.maximum(own, least - (inertia - own))
        total = inertia - own + armature
        stiffness, damping = total * (NATURAL_FREQUENCY * NATURAL_FREQUENCY), 2.0 * total * NATURAL_FREQUENCY
        effort = TIP_FORCE * lever + total * np.array(speed) / 0.1
        stated = model.jnt_actfrcrange[self.driven, 1]
        effort = np.where(model.jnt_actfrclimited[self.driven].astype(bool) & (stated > 0.0), stated, effort)
        return JointControl("servo", speed, *(_figures(values) for values in (stiffness, damping, effort, armature)))

    def _covers(self, actuator: int, index: int) -> bool:
        if not self.model.actuator_ctrllimited[actuator]:
            return True
        least, most = self.model.actuator_ctrlrange[actuator]
        return bool(least <= self.lower[index] + 1e-9 and most >= self.upper[index] - 1e-9)

    def _held(self, home: FloatArray) -> dict[str, float]:
        """Values of joints that do not move: as coupled to those that do at home, or to a root at 0 or its limit."""
        model, followers, held = self.model, self.followers, {}
        moved = dict(zip(followers.joints.tolist(), followers.values(home), strict=True))
        moved |= dict(zip(self.driven, home, strict=True))
        for joint in sorted(set(range(model.njnt)) - self.chain.moving):
            if model.jnt_type[joint] != FREE:
                path, value = joint_law(model, joint)
                root = moved.get(path[-1], np.clip(0.0, *self.survey.range_of(path[-1], math.inf)))
                held[model.joint(joint).name] = round(float(value(root)), 9) + 0.0
        return held

    def _description(
        self,
        link_shapes: tuple[AddedShape, ...],
        control: JointControl,
        home: FloatArray,
        point: FloatArray,
        into: FloatArray,
    ) -> ArmDescription:
        survey, tool = self.survey, self.tool
        fixed, tolerance = self.centre is not None, KEPT_TOLERANCE
        if self.centre is not None:
            # Other poses than those tried may miss it by a little more.
            tolerance = max(FIXED_TOLERANCE, round(1.2 * self.centre.missed, 4))
        return ArmDescription(
            name=survey.path.stem,
            folder=survey.path.parent,
            model=survey.path.name,
            kind="palpator",
            joints=tuple(self.names),
            contact=tool.contact,
            links=self.links,
            tip=Tip(
                body=survey.body_name(tool.tip_body),
                offset=vector(tool.tip_offset),
                direction=vector(tool.tip_direction),
                ball=tool.ball,
            ),
            trocar=Trocar(
                shaft_body=survey.body_name(tool.shaft_body),
                shaft_point=vector(tool.shaft_point),
                shaft_axis=vector(tool.shaft_axis),
                point=vector(point),
                into=vector(into),
                fixed=fixed,
                tolerance=tolerance,
            ),
            control=control,
            home={name: round(float(value), 9) + 0.0 for name, value in zip(self.names, home, strict=True)},
            limits=self.given_limits,
            held={**survey.locked, **self._held(home)},
            shapes=(*tool.shapes, *link_shapes),
            inertias=survey.inertias,
            dropped_meshes=survey.dropped_meshes,
            description=f"palpating arm from {survey.path.name}",
        )

    def _finish(
        self,
        link_shapes: tuple[AddedShape, ...],
        home: FloatArray,
        point: FloatArray,
        into: FloatArray,
        reach: float,
    ) -> FoundArm:
        clipped = home.round(9).clip(self.lower, self.upper)
        arm = self._search_arm(link_shapes)
        control = self._control(arm, clipped)
        description = self._description(link_shapes, control, clipped, point, into)
        held = [name for name in description.held if name not in self.survey.locked]
        if held:
            self.chosen.append(f"other joints are held: {_listed(held)}")
        if self.centre is None and self.trocar_given is None:
            self.chosen.append(f"trocar at {vector(point, 4)} m of the model's frame; --trocar x,y,z sets another one")
        self.notes.append(
            f"home with the tip {1e3 * self.depth:.0f} mm past the trocar; the tip reaches {reach:.0%} of the places "
            f"{1e2 * (self.depth + DEPTHS[0]):.0f} to {1e2 * (self.depth + DEPTHS[-1]):.0f} cm past it, up to "
            f"{math.degrees(TILT):.0f} degrees aside"
        )
        return FoundArm(description, self.notes, self.chosen, reach)


def reach_share(arm: Arm, home: FloatArray, into: FloatArray, depth: float) -> float:
    """Share of places in reach, of those at DEPTHS about a depth [m], straight on and tilted by TILT to four sides."""
    sides = np.stack(tangent_axes(into))
    ways = [into, *(float(cos(TILT)) * into + float(sin(TILT)) * side for axis in sides for side in (axis, -axis))]
    places = [arm.trocar + (depth + further) * way for way in ways for further in DEPTHS]
    poses = [solve_pose(arm, place, start=home, iterations=60) for place in places]
    return float(np.mean([max(pose.position_error, pose.trocar_error) < 1e-6 for pose in poses]))


def joint_inertia(arm: Arm, joints: Sequence[float] | FloatArray) -> FloatArray:
    """Inertia of each driven joint with its followers, the diagonal of the mass matrix [kg m^2 or kg], shape (n,)."""
    data = mujoco.MjData(arm.model)
    arm.write(data, joints)
    mujoco.mj_forward(arm.model, data)
    inertia = np.zeros((arm.model.nv, arm.model.nv))
    mujoco.mj_fullM(arm.model, data, inertia)
    return np.diag(arm.driven_columns(arm.driven_columns(inertia).T))


def _added(name: str, body: str, capsule: Capsule) -> AddedShape:
    start, end = vector(capsule.start, 6), vector(capsule.end, 6)
    return AddedShape(name, body, start, round(capsule.radius, 6), None if start == end else end)


def _figures(values: FloatArray) -> tuple[float, ...]:
    """Numbers to four significant digits."""
    return tuple(float(f"{value:.4g}") for value in values)


def _listed(names: Sequence[str], most: int = 6) -> str:
    others = len(names) - most
    return ", ".join(names[:most]) + (f" and {others} more" if others > 0 else "")
