"""Families of organs: members are smooth random deformations of a scene's organ, on the same tets.

A point of the organ at (u, v, w) [m] from its middle, across and along the approach, goes to

    1. (a s u, b s v, c t s w): size s, stretches a b c = 1, thickness t
    2. (g u, g v, w), g = 1 + sum over m = 2, 3, 4 of e_m r^m cos(m (p - p_m)): its outline, with r and p the polar
       coordinates of (u / U, v / V) and U, V half lengths
    3. x + sum of h n exp(-|x - q|^2 / (2 d^2)): bumps and dents at places q of its surface, along a direction n
    4. (u, v, w + (k_uu u^2 + 2 k_uv u v + k_vv v^2) / 2): a bend

all in the directions of the instrument. Each is smooth, and keeps tets upright as long as its slopes stay small.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from msdm_core.arithmetic import cbrt, cos, exp, log, matmul, norm, sin
from msdm_core.errors import MeshError
from msdm_core.mesh.quality import radius_ratios
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.scene.anatomy import Anatomy, MemberName
from surgsim_env.scene.load import require_known
from surgsim_env.scene.model import SPLITS, Family
from surgsim_env.scene.palpable_surface import moved_face, tangent_axes

# Default split of an environment.
DEFAULT_SPLIT = "train"
# Draws of a member before its ranges count as too wide.
TRIES_MOST = 200
# Wave numbers of the outline around the organ.
WAVES = (2, 3, 4)
# Cached anatomies, the most recently used: a liver with the tables of its chart takes some 5 MB.
CACHED_MOST = 128


@dataclass(frozen=True, eq=False)
class MemberShape:
    """Deformation of the template into a member, in the frame of the instrument.

    Fields:
        middle: of the template's box [m]                                            (3,)
        frame: the directions across (two) and along the approach, as rows           (3, 3)
        half_length: of the template's box in this frame [m]                         (3,)
        stretch: factor along each direction                                         (3,)
        wave: amplitudes of cosine and sine of each of WAVES                         (n_wave, 2)
        bump_place, bump_shift: middle and displacement of each bump [m]             (n_bump, 3)
        bump_width: standard deviation of each [m]                                   (n_bump,)
        bend: curvatures k_uu, k_uv, k_vv [1/m]                                      (3,)
    """

    middle: FloatArray
    frame: FloatArray
    half_length: FloatArray
    stretch: FloatArray
    wave: FloatArray
    bump_place: FloatArray
    bump_shift: FloatArray
    bump_width: FloatArray
    bend: FloatArray

    def __call__(self, points: FloatArray) -> FloatArray:
        """Points of the template [m] (n, 3) mapped into the member [m] (n, 3)."""
        places = matmul(np.asarray(points, dtype=np.float64) - self.middle, self.frame.T)
        spread = places[:, :2] / self.half_length[:2]
        places = places * self.stretch
        u, v = spread.T
        # Parts of (u + i v)^m: r^m cos(m p) and r^m sin(m p). numpy's complex products differ by processor.
        along, across, outline = u, v, np.zeros(len(places))
        for cosine, sine in self.wave:
            along, across = along * u - across * v, along * v + across * u
            outline += along * cosine + across * sine
        places[:, :2] *= 1.0 + outline[:, None]
        bumped = places.copy()
        for place, shift, width in zip(self.bump_place, self.bump_shift, self.bump_width, strict=True):
            square = np.square(places - place).sum(axis=1)
            bumped += exp(-square / (2.0 * (width * width)))[:, None] * shift
        u, v = bumped[:, 0], bumped[:, 1]
        k_uu, k_uv, k_vv = self.bend
        bumped[:, 2] += 0.5 * (k_uu * (u * u) + 2.0 * k_uv * u * v + k_vv * (v * v))
        return matmul(bumped, self.frame) + self.middle


def draw_shape(family: Family, template: Anatomy, rng: np.random.Generator) -> MemberShape:
    """Draw a deformation of a template from the ranges of a family."""
    points, approach = template.mesh.points, template.face.approach
    frame = np.stack([*tangent_axes(approach), approach])
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    places = matmul(points - middle, frame.T)
    size, thickness = float(rng.uniform(*family.size)), float(rng.uniform(*family.thickness))
    aspect = exp(rng.uniform(*log(family.aspect), size=3))
    stretch = size * aspect / cbrt(aspect.prod())
    stretch[2] *= thickness
    # Amplitudes of all waves together are at most `edge` where r is 1.
    phase = rng.uniform(0.0, 2.0 * math.pi, len(WAVES))
    amplitude = rng.uniform(0.0, family.edge / len(WAVES), len(WAVES))
    surface = template.mesh.boundary_nodes
    bump_nodes = surface[rng.integers(len(surface), size=family.bump_count)]
    direction = rng.normal(size=(family.bump_count, 3))
    direction /= norm(direction, axis=1, keepdims=True)
    height = rng.uniform(-family.bump_height, family.bump_height, family.bump_count)
    return MemberShape(
        middle=middle,
        frame=frame,
        half_length=np.abs(places).max(axis=0),
        stretch=stretch,
        wave=np.stack([amplitude * cos(phase), amplitude * sin(phase)], axis=1),
        bump_place=places[bump_nodes] * stretch,
        bump_shift=height[:, None] * direction,
        bump_width=rng.uniform(*family.bump_width, size=family.bump_count),
        bend=rng.uniform(-family.curvature, family.curvature, 3) * [1.0, 0.5, 1.0],
    )


def make_member(template: Anatomy, name: MemberName) -> Anatomy:
    """Anatomy of a member, reproducible: its random numbers are those of SeedSequence(entropy, (split, number)).

    Tets, anchored nodes, nodes on foundations and triangles of the palpable face are the template's. A deformation that
    turns a tet inside out, leaves one less than `quality_share` of its radius ratio, or leaves the box of the family
    (`Anatomy.box`) is drawn again.

    Raises:
        ValueError: TRIES_MOST draws give no member.
    """
    family = template.scene.family
    assert family is not None
    seed = np.random.SeedSequence(family.entropy, spawn_key=(SPLITS.index(name.split), name.number))
    rng, least = np.random.default_rng(seed), family.quality_share * radius_ratios(template.mesh)
    for _ in range(TRIES_MOST):
        shape = draw_shape(family, template, rng)
        points = shape(template.mesh.points)
        if (points < template.box[0]).any() or (points > template.box[1]).any():
            continue
        try:
            mesh = template.mesh.moved(points)
        except MeshError:
            continue
        if (radius_ratios(mesh) >= least).all():
            face = moved_face(template.face, mesh, template.scene.palpation)
            return replace(template, mesh=mesh, face=face, member=name, template=template, deformation=shape)
    raise ValueError(
        f"scene {template.scene.name!r}: {TRIES_MOST} draws of member {name} fold its tets, leave less than "
        f"{family.quality_share:g} of their quality or are larger than the family's box: narrow the ranges of "
        "[family], or lower family.quality_share"
    )


_cached_member = lru_cache(maxsize=CACHED_MOST)(make_member)


class OrganFamily:
    """Members of one split of a scene's family, generated on first use.

    Fields:
        template: the scene's organ
        split: one of SPLITS
        size: number of members
    """

    def __init__(self, template: Anatomy, split: str) -> None:
        """Take the anatomy of a scene with a family; `family_of` checks both."""
        assert template.scene.family is not None
        self.template, self.split = template, split
        self.size = template.scene.family.member_count(split)

    def member(self, number: int) -> Anatomy:
        """Member of a number; the most recently used ones are cached.

        Raises:
            ValueError: a number beyond the split.
        """
        if not 0 <= number < self.size:
            raise ValueError(
                f"scene {self.template.scene.name!r} has no member {number} in split {self.split!r}; they are numbered "
                f"from 0 to {self.size - 1}"
            )
        return _cached_member(self.template, MemberName(self.split, number))

    def draw(self, rng: np.random.Generator) -> Anatomy:
        """Draw a member uniformly."""
        return self.member(int(rng.integers(self.size)))

    def named(self, text: str) -> Anatomy:
        """Member of the name `str(anatomy.member)`.

        Raises:
            ValueError: no such member, or one of another split.
        """
        split, _, number = text.partition(" ")
        if split != self.split:
            raise ValueError(
                f"the episode is of member {text!r}, this environment plays split {self.split!r}: make it with "
                "that split"
            )
        return self.member(int(number))


def family_of(template: Anatomy, split: str | None) -> OrganFamily | None:
    """Members for the episodes of an anatomy; None for a scene of one organ.

    Args:
        template: the scene's own organ.
        split: one of SPLITS; DEFAULT_SPLIT if None.

    Raises:
        ValueError: a split for a scene without a family, or an unknown one.
    """
    if split is not None:
        require_known("split", split, SPLITS)
    if template.scene.family is not None:
        return OrganFamily(template, split or DEFAULT_SPLIT)
    if split is not None:
        raise ValueError(
            f"split is {split!r}, and scene {template.scene.name!r} is one organ, without a [family] that has splits: "
            "leave it out, or take a family, such as 'liver_family'"
        )
    return None
