"""Survey of a model file: joints of its tip, outer shapes, straight shaft, remote centre."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np

from msdm_core.arithmetic import cbrt, cos, dot, eigh, lstsq, matmul, norm, sin, solve, svd
from msdm_core.mesh import FloatArray
from surgsim_apps.arms.urdf_links import faulty_links, speed_limits
from surgsim_env.instruments import (
    Followers,
    followers_of,
    hold_joints,
    joint_law,
    linear_law,
    narrowed_limits,
    read_model,
    read_xml,
    shape_faults,
    warned,
)
from surgsim_env.scene import LinkInertia, Vector, nearest

# Densities of links without a mass and of links without a shape [kg/m^3]: chosen, water and aluminium.
SHAPE_DENSITY, BARE_DENSITY = 1000.0, 2700.0
# Mass of a link that states none and has no shape [kg].
BARE_MASS = 0.01
# A solid link's smallest thickness for its moments [m].
THICKNESS_LEAST = 0.002
# A part is a straight shaft if it is this long and no thicker [m].
SHAFT_LENGTH_LEAST, SHAFT_RADIUS_MOST = 0.10, 0.008
# Largest size of a shape and distance of a link from its parent, smallest size of a mesh [m]: beyond, a unit is wrong.
LENGTH_MOST, MESH_LEAST = 5.0, 0.001
# Largest distance of axes from their meeting point [m].
MEETING_TOLERANCE = 1e-4
# A shaft has a remote centre if it passes a point by no more in so many poses [m]: chosen, for the parallelogram of
# jhu-dvrk/dvrk_model's da Vinci Si, which leaves it by 4.7 mm.
CENTRE_TOLERANCE, POSES = 5e-3, 1000
# Joints before a remote centre set it up and are held if so many driven ones remain: chosen, a tip's freedoms.
DRIVEN_LEAST = 6
# Words in the names of frames at a tool's tip.
TIP_WORDS = ("tip", "tcp", "tool0", "end_effector", "ee_link", "attachment", "flange")
# As numbers: a numpy integer equals no member of MuJoCo's enumerations.
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
SPHERE, CAPSULE, CYLINDER, ELLIPSOID, BOX, MESH, PLANE, FIELD = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("SPHERE", "CAPSULE", "CYLINDER", "ELLIPSOID", "BOX", "MESH", "PLANE", "HFIELD")
)


@dataclass(frozen=True)
class Capsule:
    """A capsule in a body's frame, or a ball if both ends are the same.

    Fields:
        start, end: of its axis [m]                                                 (3,)
        radius: [m]                                                                 scalar
    """

    start: FloatArray
    end: FloatArray
    radius: float

    @property
    def length(self) -> float:
        """Overall length [m]."""
        return float(norm(self.end - self.start)) + 2.0 * self.radius


@dataclass(frozen=True)
class RemoteCentre:
    """The point through which a mechanism keeps its shaft.

    Fields:
        point: in the model's own frame [m]                                         (3,)
        body: of the shaft
        shaft_point, shaft_axis: in that body's frame [m], the axis towards the tip (3,)
        joint: the slide for inserting the shaft
        turning: indices of the driven joints that turn the shaft about the point
        depths: least and largest depth of the tip past the point, its wrist straight [m]  (2,)
        missed: largest distance of the shaft's axis from the point [m]
    """

    point: FloatArray
    body: int
    shaft_point: FloatArray
    shaft_axis: FloatArray
    joint: int
    turning: frozenset[int]
    depths: tuple[float, float]
    missed: float


@dataclass(frozen=True)
class Chain:
    """Joints that move a tip.

    Fields:
        joints: from the base to the tip
        driven: those of them with a drive, n
        followers: the others, and joints beside the chain that its joints follow
        moving: all of these but joints beside the chain that one alone follows: that is driven in their place
        limits: of the driven joints, within those of their followers; infinite without any [rad or m]   (n, 2)
    """

    joints: list[int]
    driven: list[int]
    followers: Followers
    moving: set[int]
    limits: FloatArray


class ModelSurvey:
    """Content of a model file, compiled alone.

    Fields:
        path: of the file
        inertias: made from shapes for those missing or wrong in a URDF
        dropped_meshes: of a URDF, missing or unreadable
        left_out: links and meshes of a URDF's shapes that are left out, by reason
        speed_limits: of a URDF [rad/s or m/s]
        locked: values of joints that cannot move by their limits or couplings [rad or m]; taken out of the model
        crossed: limits of joints in whose file the lower is above the upper one, in order [rad or m]
        angle_unit: of the file's hinges [rad]
        model, data: of MuJoCo, at the model's initial joint values
    """

    def __init__(self, path: Path) -> None:
        """Read and compile a file.

        Raises:
            ValueError: a missing file, no MJCF or URDF, a file that MuJoCo refuses, a size of no arm.
        """
        self.path = path
        root = read_xml(path)
        self.is_urdf = root.tag == "robot"
        self.inertias: tuple[LinkInertia, ...] = ()
        self.dropped_meshes: tuple[str, ...] = ()
        self.left_out: dict[str, list[str]] = {}
        self.locked: dict[str, float] = {}
        self.crossed: dict[str, tuple[float, float]] = {}
        self.speed_limits: dict[str, float] = {}
        if self.is_urdf:
            dropped, self.left_out = shape_faults(root, path)
            self.dropped_meshes = tuple(dropped)
            self.speed_limits = speed_limits(root)
            faults = faulty_links(root)
            ball = [LinkInertia(name, 1.0, (0.0, 0.0, 0.0), (1e-3, 1e-3, 1e-3)) for name in faults]
            self._compile(ball)
            self.inertias = tuple(self._solid_link(name, *faults[name]) for name in faults)
        self._compile(self.inertias)
        self.locked, self.crossed = self._locked(), self._crossed()
        if self.locked:
            self._compile(self.inertias)
        for name, limits in self.crossed.items():
            self.model.joint(name).range, self.model.joint(name).limited = limits, 1
        self._check_sizes()

    def _compile(self, inertias: Sequence[LinkInertia]) -> None:
        with self._named(), warned(f"arm {self.path.stem!r}"):
            spec = read_model(self.path, inertias, self.dropped_meshes)
            self.angle_unit = math.radians(1.0) if spec.compiler.degree else 1.0
            hold_joints(spec, self.locked)
            self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)

    def _ignored_limits(self) -> Iterator[tuple[int, float, float]]:
        """Joints whose limits MuJoCo ignores, and these [rad or m]; it leaves them in the file's unit."""
        for joint in np.flatnonzero(self.model.jnt_limited == 0):
            unit = self.angle_unit if self.model.jnt_type[joint] == HINGE else 1.0
            lower, upper = unit * self.model.jnt_range[joint]
            yield int(joint), float(lower), float(upper)

    def _crossed(self) -> dict[str, tuple[float, float]]:
        return {self.model.joint(joint).name: (high, low) for joint, low, high in self._ignored_limits() if low > high}

    def _locked(self) -> dict[str, float]:
        """Joints with equal limits (0 and 0 state none), those coupled to them, and constant ones."""
        model, values = self.model, {}
        with self._named():
            laws = [joint_law(model, joint) for joint in range(model.njnt)]
            for joint, low, high in self._ignored_limits():
                if low == high != 0.0 and laws[joint].value.degree():
                    root, slope, offset = linear_law(model, joint)
                    value = (low - offset) / slope
                    if abs(values.setdefault(root, value) - value) > 1e-9:
                        raise ValueError(
                            f"joint {model.joint(joint).name!r} has the equal limits {low:g}, against those of a joint "
                            "coupled to it: change either, or the coupling"
                        )
        return {
            model.joint(joint).name: round(float(value(values.get(path[-1], 0.0))), 9) + 0.0
            for joint, (path, value) in enumerate(laws)
            if path[-1] in values or not value.degree()
        }

    def _check_sizes(self) -> None:
        model = self.model
        for body in range(1, model.nbody):
            where = f"model file {self.path}: link {self.body_name(body)}"
            parent, away = int(model.body_parentid[body]), float(norm(model.body_pos[body]))
            if parent and away > LENGTH_MOST:
                raise ValueError(f"{where} is {away:.3g} m away from {self.body_name(parent)}: is that in mm?")
            for geom in self.body_geoms(body):
                points = self.geom_points(geom)
                if not len(points):
                    continue
                length = float(np.ptp(points, axis=0).max())
                if length > LENGTH_MOST:
                    raise ValueError(f"{where} is {length:.3g} m long: scale 0.001 missing?")
                if model.geom_type[geom] == MESH and length < MESH_LEAST:
                    raise ValueError(f"{where} has a mesh only {length:.1g} m long: scale 0.001 applied twice?")

    def _solid_link(self, name: str, mass: float, centre: FloatArray) -> LinkInertia:
        """Mass and moments of a solid block around a link's shapes, or of a cube for a link without one."""
        points = self.body_points(self.model.body(name).id)
        if len(points):
            size = np.maximum(np.ptp(points, axis=0), THICKNESS_LEAST)
            if mass == 0.0:
                mass, centre = SHAPE_DENSITY * float(size.prod()), 0.5 * (points.min(axis=0) + points.max(axis=0))
        else:
            mass = mass or BARE_MASS
            size = np.full(3, cbrt(mass / BARE_DENSITY))
        square = size * size
        moments = mass / 12.0 * (square.sum() - square)
        return LinkInertia(name, mass, vector(centre), vector(moments, digits=None))

    # ---- bodies and joints -----------------------------------------------------------------------------------

    def body_name(self, body: int) -> str:
        """A body's name."""
        return self.model.body(body).name

    def parents(self, body: int) -> list[int]:
        """A body and its ancestors, without the world."""
        bodies = []
        while body:
            bodies.append(body)
            body = int(self.model.body_parentid[body])
        return bodies

    def body_joints(self, body: int) -> list[int]:
        """Joints of a body."""
        first, count = int(self.model.body_jntadr[body]), int(self.model.body_jntnum[body])
        return list(range(first, first + count))

    def chain(self, body: int, first: int = 0) -> Chain:
        """Joints from the base to a body, from that of an index on.

        Raises:
            ValueError: there is none, or a coupling that an arm may not have.
        """
        joints = self._joints_to(body)[first:]
        if not joints:
            raise ValueError(f"model file {self.path}: no joint moves {self.body_name(body)!r}: name another --tip")
        driven = self._driven(joints)
        with self._named():
            paths = [joint_law(self.model, joint).path for joint in joints]
            roots = [path[-1] for path in paths]
            moving = {*joints, *(part for path in paths if roots.count(path[-1]) > 1 for part in path)}
            followers = followers_of(self.model, driven, sorted({part for path in paths for part in path}))
            return Chain(joints, driven, followers, moving, narrowed_limits(self.model, driven, followers))

    def _driven(self, joints: Sequence[int]) -> list[int]:
        """Joints to be driven: of those with one root, the root or else the first."""
        driven: dict[int, int] = {}
        for joint in joints:
            root = joint_law(self.model, joint).path[-1]
            if joint == root or root not in driven:
                driven[root] = joint
        return sorted(driven.values(), key=joints.index)

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except (TypeError, RuntimeError, ValueError, mujoco.FatalError) as error:
            raise ValueError(f"model file {self.path}: {' '.join(str(error).split())}") from None

    def find_tip(self, named: str | None) -> tuple[int, FloatArray | None]:
        """The body of the tip, and the tip's offset in that body [m] (3,) if a frame marks it.

        Without a name it is a frame fixed to the last link of the longest chain of driven joints (of equal ones the one
        with more followers), or that link; of a chain that ends in several fingers, their common link.

        Raises:
            ValueError: a name of neither a body nor a site.
        """
        model = self.model
        sites = {model.site(index).name: index for index in range(model.nsite)}
        bodies = {self.body_name(index): index for index in range(1, model.nbody)}
        if named is not None:
            if named in bodies:
                return self._marked(bodies[named])
            if named in sites:
                return self._at_site(sites[named])
            known = sorted(name for name in (*bodies, *sites) if name)
            raise ValueError(f"--tip: {self.path.name} has no link or site {named!r}{nearest(named, known)}")
        paths = [self._joints_to(body) for body in range(model.nbody)]
        counts = [(len(self._driven(path)), len(path)) for path in paths]
        deepest = [body for body in range(model.nbody) if counts[body] == max(counts)]
        if max(counts) == (0, 0):
            raise ValueError(f"model file {self.path} has no joint that moves: name the model of an arm")
        ends = {self._joints_to(body)[-1] for body in deepest}
        last = int(model.jnt_bodyid[min(ends)])
        if len(ends) > 1:
            carriers = [self.parents(int(model.jnt_bodyid[joint])) for joint in sorted(ends)]
            last = next((body for body in carriers[0] if all(body in part for part in carriers)), 0)
            if not self._joints_to(last):
                names = ", ".join(self.body_name(path[0]) for path in carriers)
                raise ValueError(
                    f"model file {self.path} ends in {len(carriers)} chains of {max(counts)} joints: name the tip of "
                    f"one, --tip {names}"
                )
        fixed = [body for body in range(1, model.nbody) if self._fixed_to(body, last)]
        marks = [index for index in range(model.nsite) if int(model.site_bodyid[index]) in fixed]
        marks = [index for index in marks if _has_tip_word(model.site(index).name)]
        if marks:
            return self._at_site(marks[0])
        frames = [body for body in fixed if body != last and _has_tip_word(self.body_name(body))]
        return self._marked(frames[-1] if frames else last)

    def _marked(self, body: int) -> tuple[int, FloatArray | None]:
        """A body; its origin is the tip if it is a frame fixed to a link, without shapes of its own."""
        frame = not self.body_joints(body) and not len(self.body_points(body))
        return body, np.zeros(3) if frame else None

    def _at_site(self, site: int) -> tuple[int, FloatArray]:
        return int(self.model.site_bodyid[site]), self.model.site_pos[site].copy()

    def _joints_to(self, body: int) -> list[int]:
        return [joint for part in reversed(self.parents(body)) for joint in self.body_joints(part)]

    def _fixed_to(self, body: int, link: int) -> bool:
        for part in self.parents(body):
            if part == link:
                return True
            if self.body_joints(part):
                return False
        return False

    def place(self, chain: Chain, values: FloatArray) -> None:
        """Compute the kinematics at values of a chain's driven joints [rad or m], others as the model has them."""
        place = self.model.jnt_qposadr
        self.data.qpos[:] = self.model.qpos0
        self.data.qpos[place[chain.driven]] = values
        self.data.qpos[place[chain.followers.joints]] = chain.followers.values(values)
        mujoco.mj_kinematics(self.model, self.data)

    def range_of(self, joint: int, unlimited: float) -> tuple[float, float]:
        """Limits of a joint [rad or m]; for one without, plus and minus `unlimited`."""
        if self.model.jnt_limited[joint]:
            low, high = self.model.jnt_range[joint]
            return float(low), float(high)
        return -unlimited, unlimited

    # ---- shapes ----------------------------------------------------------------------------------------------

    def geom_points(self, geom: int) -> FloatArray:
        """Points with a geom in their hull, in its body's frame [m], (n, 3); none for a plane."""
        model, size = self.model, self.model.geom_size[geom]
        kind = model.geom_type[geom]
        if kind == MESH:
            mesh = int(model.geom_dataid[geom])
            first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            points = model.mesh_vert[first : first + count].astype(np.float64)
        elif kind in (PLANE, FIELD):
            return np.zeros((0, 3))
        else:
            points = _hull(kind, size)
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        return matmul(points, rotation.reshape(3, 3).T) + model.geom_pos[geom]

    def body_geoms(self, body: int) -> list[int]:
        """Geoms of a body."""
        first, count = int(self.model.body_geomadr[body]), int(self.model.body_geomnum[body])
        return list(range(first, first + count))

    def body_points(self, body: int) -> FloatArray:
        """Points around a body's shapes, in its frame [m], (n, 3)."""
        return np.concatenate([np.zeros((0, 3)), *(self.geom_points(geom) for geom in self.body_geoms(body))])

    def round_geoms(self, body: int) -> list[int]:
        """Named spheres and capsules of a body."""
        kinds = (SPHERE, CAPSULE)
        return [g for g in self.body_geoms(body) if self.model.geom_type[g] in kinds and self.model.geom(g).name]

    @cached_property
    def shaft(self) -> dict[int, Capsule]:
        """The longest straight thin part of a body, by body."""
        shafts: dict[int, Capsule] = {}
        for body in range(1, self.model.nbody):
            fitted = [fit_capsule(points) for g in self.body_geoms(body) if len(points := self.geom_points(g))]
            thin = [capsule for capsule in fitted if is_shaft(capsule)]
            if thin:
                shafts[body] = max(thin, key=lambda capsule: capsule.length)
        return shafts

    # ---- remote centre ---------------------------------------------------------------------------------------

    def centred_chain(self, tip: int, offset: FloatArray) -> tuple[Chain, RemoteCentre | None]:
        """The chain of a tip and its remote centre; without the joints before that if six driven ones remain."""
        whole = self.chain(tip)
        for first in range(len(whole.joints)):
            chain = self.chain(tip, first)
            if first and len(chain.driven) < DRIVEN_LEAST:
                break
            centre = self.remote_centre(chain, tip, offset)
            if centre is not None:
                return chain, centre
        return whole, None

    def remote_centre(self, chain: Chain, tip: int, offset: FloatArray) -> RemoteCentre | None:
        """The point that the line of a shaft's slide passes in all poses, within CENTRE_TOLERANCE.

        In the frame of the shaft's link (position x, rotation R) the line passes through c along a. The point p and c
        are the least-squares solution of (I - R a a^T R^T) (p - x - R c) = 0 over POSES poses. They are a
        single one if at least two driven joints turn the shaft.
        """
        model = self.model
        slides = [index for index, joint in enumerate(chain.joints) if model.jnt_type[joint] == SLIDE]
        if not slides:
            return None
        driven, limits, slide = chain.driven, chain.limits, chain.joints[slides[0]]
        drivers = dict(zip(chain.followers.joints.tolist(), chain.followers.driver.tolist(), strict=True))
        drivers |= {joint: index for index, joint in enumerate(driven)}
        *turning, inserting = (drivers[joint] for joint in chain.joints[: slides[0] + 1])
        if not np.isfinite(limits[inserting]).all():
            return None
        lower, upper = np.where(np.isfinite(limits), limits, [-np.pi, np.pi]).T
        self.place(chain, 0.5 * (lower + upper))
        body = self._shaft_body(chain.joints, slides[0])
        rows, right = [], []
        for values in np.random.default_rng(0).uniform(lower, upper, (POSES, len(driven))):
            self.place(chain, values)
            axis = self.data.xaxis[slide]
            across = np.eye(3) - axis[:, None] * axis
            rows.append(np.hstack([across, -matmul(across, self.data.xmat[body].reshape(3, 3))]))
            right.append(matmul(across, self.data.xpos[body]))
        # c is free along a. Another free direction is that of an axis about which alone the shaft turns.
        if svd(np.vstack(rows))[1][-2] < 1e-2:
            return None
        solution = lstsq(np.vstack(rows), np.concatenate(right))
        missed = float(norm(matmul(np.array(rows), solution) - right, axis=1).max())
        if missed > CENTRE_TOLERANCE:
            return None
        point, on_line = np.split(solution, 2)
        axis, reach = matmul(self.data.xmat[body].reshape(3, 3).T, self.data.xaxis[slide]), []
        for end in limits[inserting]:
            joints = np.clip(model.qpos0[model.jnt_qposadr[driven]], lower, upper)
            joints[inserting] = end
            self.place(chain, joints)
            along = matmul(self.data.xmat[body].reshape(3, 3), axis)
            tip_now = self.data.xpos[tip] + matmul(self.data.xmat[tip].reshape(3, 3), offset)
            reach.append(float(matmul(tip_now - point, along)))
        sign = float(np.sign(max(reach, key=abs)))
        least, most = sorted(sign * value for value in reach)
        turning = frozenset(turning) - {inserting}
        shaft_point = on_line - matmul(on_line, axis) * axis
        return RemoteCentre(point, body, shaft_point, sign * axis, slide, turning, (least, most), missed)

    def _shaft_body(self, chain: Sequence[int], slide: int) -> int:
        """The last body with no motion but along the line of a slide and about it, in the current pose."""
        body = int(self.model.jnt_bodyid[chain[slide]])
        axis = self.data.xaxis[chain[slide]]
        line = None
        for joint in chain[slide + 1 :]:
            if norm(np.cross(self.data.xaxis[joint], axis)) > 1e-6:
                break
            if self.model.jnt_type[joint] == HINGE:
                line = self.data.xanchor[joint] if line is None else line
                if norm(np.cross(self.data.xanchor[joint] - line, axis)) > MEETING_TOLERANCE:
                    break
            body = int(self.model.jnt_bodyid[joint])
        return body


def meeting_point(points: FloatArray, axes: FloatArray) -> FloatArray | None:
    """The common point (3,) of lines with points and unit axes (n, 3); None if there is no single one."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0)
    if eigh(total)[0][0] < 1e-3:
        return None
    point = solve(total, dot(across, points[:, None]).sum(axis=0))
    missed = norm(dot(across, (point - points)[:, None]), axis=1).max()
    return point if missed <= MEETING_TOLERANCE else None


def fit_capsule(points: FloatArray) -> Capsule:
    """A capsule around points (n, 3), along their longest principal axis."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    around = points - middle
    axis = eigh(matmul(around.T, around))[1][:, -1]
    height = matmul(around, axis)
    beside = around - height[:, None] * axis
    aside = 0.5 * (beside.min(axis=0) + beside.max(axis=0))
    aside = aside - matmul(aside, axis) * axis
    radius = max(float(norm(beside - aside, axis=1).max()), 1e-4)
    centre = middle + aside
    # The ends of the capsule are round: the cylinder's corners are inside up to the axis' ends.
    low, high = float(height.min()), float(height.max())
    if high - low <= 2.0 * radius:
        centre = centre + 0.5 * (low + high) * axis
        return Capsule(centre, centre, float(norm(points - centre, axis=1).max()))
    return Capsule(centre + low * axis, centre + high * axis, radius)


def is_shaft(capsule: Capsule) -> bool:
    """True if a capsule is long and thin enough for a laparoscopic instrument's shaft."""
    return capsule.length >= SHAFT_LENGTH_LEAST and capsule.radius <= SHAFT_RADIUS_MOST


def vector(values: FloatArray, digits: int | None = 9) -> Vector:
    """Three numbers as a tuple, rounded to a number of decimals, without -0."""
    x, y, z = (float(value) if digits is None else round(float(value), digits) + 0.0 for value in values)
    return x, y, z


def _has_tip_word(name: str) -> bool:
    return any(word in name.lower() for word in TIP_WORDS)


def _hull(kind: int, size: FloatArray) -> FloatArray:
    """Points around a sphere, capsule, cylinder, ellipsoid or box in its own frame [m], (n, 3)."""
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    ring = np.stack([cos(angle), sin(angle), np.zeros(16)], axis=1)
    if kind == BOX or kind == ELLIPSOID:
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        return corners * size if kind == BOX else np.vstack([np.eye(3), -np.eye(3)]) * size
    half = 0.0 if kind == SPHERE else float(size[1])
    ends = [np.array([0.0, 0.0, end]) for end in (-half, half)]
    caps = 0.0 if kind == CYLINDER else float(size[0])
    tops = [np.array([[0.0, 0.0, end * (half + caps)]]) for end in (-1.0, 1.0)]
    return np.concatenate([*(ring * size[0] + end for end in ends), *tops])
