"""Compilation of an organ from its specification, and its state at rest.

Under gravity an organ settles on its anchors and supports by dynamic relaxation, cached for the last organs.
"""

import hashlib
import math
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msdm_core.arithmetic import norm
from msdm_core.errors import OrganDivergedError, OrganError
from msdm_core.kernels.element_kernels import STEEP_EXCESS
from msdm_core.kernels.squeeze_kernels import STEEP_HOLD, VOLUME_HOLD
from msdm_core.kernels.structure_kernels import FAULT_NONE, OrganModel, OrganState
from msdm_core.kernels.substep_kernels import evaluate_forces
from msdm_core.kernels.support_kernels import add_foundation_forces, add_support_forces
from msdm_core.material.lumping import MassScheme, lump_mass
from msdm_core.material.regions import (
    Capsule,
    Damping,
    Lesion,
    Material,
    averaged_volume_modulus,
    boundary_layer,
    lesion_fraction,
    mixed_moduli,
    nodal_average,
)
from msdm_core.material.stiffness import membrane_stiffness, spring_network, spring_sum
from msdm_core.material.tissue_law import ARM_COUNT, Stiffening
from msdm_core.mesh.curvature import boundary_rise
from msdm_core.mesh.ordering import spring_order
from msdm_core.mesh.tet_mesh import FloatArray, TetMesh, area_vectors
from msdm_core.mesh_files.mesh_file import LARGEST_EXTENT, SMALLEST_EXTENT
from msdm_core.organ.foundation import Foundation, foundation_fields
from msdm_core.organ.measure import element_strains, element_tensions, node_strains
from msdm_core.organ.motion import Motion, motion_fields
from msdm_core.organ.stability import own_step, steep_sweeps
from msdm_core.organ.state import blank_state
from msdm_core.organ.stepping import NO_CONTACT, NO_SHAPES, advance_organ, describe_fault
from msdm_core.organ.support import Support, SupportLaw, support_fields

# A hundred times the Earth's [m/s^2]; no organ settles under more, and forces overflow.
GRAVITY_LARGEST = 1000.0
# Settled organs in the cache, the most recently used.
CACHED = 32
# Tolerance of equilibrium: sum of the magnitudes of node forces over the weight of the organ.
FORCE_TOLERANCE = 1e-6
ROUNDS, ROUND_STEPS = 4000, 10

_settled: OrderedDict[bytes, tuple[FloatArray, FloatArray]] = OrderedDict()


@dataclass(frozen=True)
class OrganSpec:
    """Specification of an organ, for `compile_organ`.

    Args:
        mesh: its tets.
        materials: one Material, or a mapping from the name of each mesh region to its Material.
        capsule: the outer layer, or None.
        lesions: regions of their own material, applied in order.
        anchors: indices of the nodes held fixed, shape (n_anchor,).
        damping: Rayleigh damping; the default damps a 10 Hz mode with ratio 0.1.
        mass_scheme: "barycentric" (eq. 2) or "voronoi" (eq. 5).
        stiffness_rule: "lloyd" (eq. 6) or "fitted" (eq. 6 times factors fitted to the mesh).
        gravity: [m/s^2]; off by default, because a scanned shape is the equilibrium.
        supports: fixed solids below it.
        support_law: their contact law.
        foundations: elastic foundations of its surface.
        motions: of anchors, supports and foundations (`organ.motion`).
    """

    mesh: TetMesh
    materials: Material | Mapping[str, Material]
    capsule: Capsule | None = None
    lesions: tuple[Lesion, ...] = ()
    anchors: ArrayLike = ()
    damping: Damping = field(default_factory=lambda: Damping(alpha=4.0 * math.pi))
    mass_scheme: MassScheme = "barycentric"
    stiffness_rule: str = "lloyd"
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    supports: tuple[Support, ...] = ()
    support_law: SupportLaw = field(default_factory=SupportLaw)
    foundations: tuple[Foundation, ...] = ()
    motions: tuple[Motion, ...] = ()


def compile_organ(spec: OrganSpec) -> OrganModel:
    """Masses, springs and volume moduli of an organ, as read-only arrays for the kernels.

    A tet partly inside a lesion has the mean density by volume, and `mixed_moduli`.

    Raises:
        OrganError: an organ of impossible size, a region without material, a lesion outside the organ or smaller than
            a cell, an anchor that is no node, a support smaller than a cell, a foundation off the surface.
    """
    mesh = spec.mesh
    _check_extent(mesh)
    spring_modulus, bulk, density, law = _tet_properties(spec)
    averaged_bulk = averaged_volume_modulus(mesh, spring_modulus, bulk)
    node_volume, node_bulk = nodal_average(mesh, averaged_bulk)
    nodes, stiffness = spring_network(mesh, spring_modulus, rule=spec.stiffness_rule)
    if spec.capsule is not None and spec.capsule.thickness is not None:
        stiffness = stiffness + membrane_stiffness(mesh, spec.capsule.youngs_modulus, spec.capsule.thickness)
    mass = lump_mass(mesh, density, scheme=spec.mass_scheme)
    order = spring_order(mesh)
    nodes, stiffness = nodes[order.springs], stiffness[order.springs]
    tissue_law = _tissue_law(spec, law, spring_modulus, bulk, order.springs, stiffness)
    anchored = _anchor_mask(spec.anchors, mesh.node_count)
    open_triangles = ~anchored[mesh.boundary_triangles].all(axis=1)
    surface = mesh.boundary_triangles[open_triangles]
    rise = boundary_rise(mesh)
    supports = support_fields(spec.supports, spec.support_law, mesh, surface, anchored)
    foundations = foundation_fields(spec.foundations, mesh, anchored)
    model = OrganModel(
        node_rest_position=mesh.points,
        node_mass=mass,
        node_inverse_mass=np.where(anchored, 0.0, 1.0 / mass),
        spring_nodes=nodes,
        spring_stiffness=stiffness,
        spring_rest_length=norm(mesh.points[nodes[:, 0]] - mesh.points[nodes[:, 1]], axis=1),
        **tissue_law,
        tet_nodes=order.tet_nodes,
        tet_rest_volume=mesh.volumes,
        tet_inverse_volume=1.0 / mesh.volumes,
        tet_bulk=bulk - averaged_bulk,
        tet_barrier_bulk=bulk,
        node_rest_volume=node_volume,
        node_inverse_volume=1.0 / node_volume,
        node_bulk=node_bulk,
        averages_volume=bool(node_bulk.any()),
        surface_triangles=np.ascontiguousarray(surface),
        surface_rest_area=norm(area_vectors(mesh.points[surface]), axis=1),
        surface_around=rise.node[open_triangles],
        surface_rise=rise.weight[open_triangles],
        **supports,
        **foundations,
        **motion_fields(
            spec.motions, mesh.points, anchored, foundations["foundation_nodes"], supports["support_position"]
        ),
        gravity=_checked_gravity(spec.gravity),
        alpha=float(spec.damping.alpha),
        beta=float(spec.damping.beta),
        stable_step=0.0,
        added_mass=0.0,
    )
    model = OrganModel._make(_read_only(value) if isinstance(value, np.ndarray) else value for value in model)
    return model._replace(stable_step=own_step(model))


def rest_state(model: OrganModel, *, shape_count: int = 0) -> OrganState:
    """State at rest, with contact memory for `shape_count` shapes; under gravity the static equilibrium.

    The organ settles from its undeformed shape onto its supports, their friction included.

    Raises:
        OrganDivergedError: gravity turns the organ inside out or it does not settle.
    """
    state = blank_state(model, shape_count=shape_count)
    if np.any(model.gravity != 0.0):
        _settle(model, state)
    return state


def _settle(model: OrganModel, state: OrganState) -> None:
    """Bring a state from the undeformed position to rest under gravity, in place; cached for the same organ."""
    key = _content(model)
    settled = _settled.pop(key, None)
    if settled is None:
        _relax(model, state)
        settled = state.node_position.copy(), state.support_stretch.copy()
    # Moved to the end: the least recently used organ is forgotten first.
    _settled[key] = settled
    if len(_settled) > CACHED:
        _settled.popitem(last=False)
    state.node_position[:], state.support_stretch[:] = settled
    relax_arms(model, state)
    state.node_velocity[:] = 0.0
    state.node_force[:] = 0.0
    # The smallest volume ratio on the way to equilibrium does not count.
    state.volume_ratio_smallest[:] = 1.0


def _content(model: OrganModel) -> bytes:
    """Digest of all numbers of an organ."""
    digest = hashlib.blake2b(digest_size=16)
    for value in model:
        array = np.ascontiguousarray(value)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.data)
    return digest.digest()


def _relax(model: OrganModel, state: OrganState) -> None:
    """Dynamic relaxation: advance the organ, the mode excited by gravity critically damped, until forces balance.

    alpha = 2 w, w^2 = -(u . f) / (u . M u) (Rayleigh's quotient of the displacement u, f the forces without gravity).
    """
    # Without Maxwell arms, whose tension is 0 in equilibrium.
    relaxed = model._replace(alpha=0.0, beta=0.0, relaxes=False)
    free = model.node_inverse_mass > 0.0
    mass = model.node_mass[:, None]
    weight = float(norm(model.gravity) * model.node_mass.sum())
    wrench = np.zeros((0, 6))
    dt = 0.8 * own_step(relaxed)
    for _ in range(ROUNDS):
        fault = advance_organ(relaxed, state, NO_SHAPES, NO_CONTACT, dt, ROUND_STEPS, wrench)
        if fault != FAULT_NONE:
            raise OrganDivergedError("under gravity, " + describe_fault(relaxed, state, fault))
        evaluate_forces(relaxed, state)
        add_support_forces(
            relaxed, state.ground_support, state.node_position, state.node_velocity, state.node_force,
            state.support_stretch, state.ground_load, 0.0,
        )  # fmt: skip
        add_foundation_forces(
            relaxed.foundation_nodes, state.ground_foundation, relaxed.foundation_stiffness,
            state.node_position, state.node_force,
        )  # fmt: skip
        if norm(state.node_force[free], axis=1).sum() <= FORCE_TOLERANCE * weight:
            return
        displacement = state.node_position - model.node_rest_position
        held = float((displacement * (mass * model.gravity - state.node_force)).sum())
        relaxed = relaxed._replace(
            alpha=2.0 * math.sqrt(max(held, 0.0) / float((mass * (displacement * displacement)).sum()))
        )
    raise OrganDivergedError(
        f"the organ did not settle under gravity in {ROUNDS * ROUND_STEPS} steps: is it anchored, or does it "
        "rest on something? Give `anchors` or `supports`, or no gravity"
    )


def _check_extent(mesh: TetMesh) -> None:
    extent = float(np.ptp(mesh.points, axis=0).max())
    if not SMALLEST_EXTENT <= extent <= LARGEST_EXTENT:
        raise OrganError(
            f"the organ is {extent:.4g} m long; the rule is {SMALLEST_EXTENT:g} to {LARGEST_EXTENT:g} m: "
            'was its length unit forgotten? (length_unit="mm")'
        )


def _checked_gravity(gravity: tuple[float, float, float]) -> FloatArray:
    vector = np.array(gravity, dtype=np.float64)
    if vector.shape != (3,) or not (np.abs(vector) <= GRAVITY_LARGEST).all():
        raise OrganError(
            f"gravity is {gravity}; it must be three finite numbers up to {GRAVITY_LARGEST:g} m/s^2, as (0, 0, -9.81)"
        )
    return vector


@dataclass(frozen=True)
class _TetLaw:
    """Stiffening and relaxation of each tet.

    Fields:
        rise: c - 1, 0 for linear tissue                                         (n_tet,)
        onset, width: e0 and e1 - e0, times the rise                             (n_tet,)
        arm_modulus: g_i                                                         (3, n_tet)
    """

    rise: FloatArray
    onset: FloatArray
    width: FloatArray
    arm_modulus: FloatArray

    @classmethod
    def linear(cls, count: int) -> "_TetLaw":
        """Linear tissue in `count` tets."""
        return cls(np.zeros(count), np.zeros(count), np.zeros(count), np.zeros((ARM_COUNT, count)))

    def mix(self, material: Material, fraction: FloatArray | float, members: Any = slice(None)) -> None:
        """Fill a fraction of the volume of member tets with a material, in place: means by volume."""
        stiffening = material.stiffening or Stiffening(0.0, 1.0, 1.0)
        rise = stiffening.tangent_cap - 1.0
        for array, value in (
            (self.rise, rise),
            (self.onset, rise * stiffening.onset_strain),
            (self.width, rise * stiffening.width),
        ):
            array[members] += fraction * (value - array[members])
        moduli = np.zeros((ARM_COUNT, 1))
        if material.relaxation is not None:
            moduli[: len(material.relaxation.times), 0] = material.relaxation.relative_moduli
        self.arm_modulus[:, members] += fraction * (moduli - self.arm_modulus[:, members])


def _tissue_law(
    spec: OrganSpec,
    law: _TetLaw,
    spring_modulus: FloatArray,
    bulk: FloatArray,
    springs: NDArray[np.intp],
    stiffness: FloatArray,
) -> dict[str, Any]:
    """Fields of an OrganModel for stiffening and relaxation, springs in the kernels' order with their stiffness [N/m].

    A node stiffens, and its averaged volume relaxes, by the mean of its tets, weighted by volume and modulus; a spring
    relaxes by the mean of its tets, weighted by their shares of its stiffness. Organs side by side share these fields
    but node_softness: an amount equal in all tets has the same bits everywhere, independent of the moduli.
    """
    mesh = spec.mesh

    def spring_mean(amount: FloatArray) -> FloatArray:
        first = float(amount[0])
        total = spring_sum(mesh, spring_modulus, spec.stiffness_rule)
        difference = spring_sum(mesh, spring_modulus * (amount - first), spec.stiffness_rule)
        return first + (difference / total)[springs]

    def node_sum(values: FloatArray) -> FloatArray:
        return np.bincount(mesh.tets.ravel(), np.repeat(values, 4), mesh.node_count).astype(np.float64)

    def node_mean(amount: FloatArray, weight: FloatArray) -> FloatArray:
        # Nodes without weight have the amount of the first tet with a weight.
        first = float(amount[np.argmax(weight > 0.0)])
        total = node_sum(weight)
        difference = node_sum(weight * (amount - first))
        return first + np.divide(difference, total, out=np.zeros_like(total), where=total > 0.0)

    empty = np.zeros(0)
    fields: dict[str, Any] = dict.fromkeys(
        ("node_softness", "node_onset", "node_growth", "node_excess", "spring_hold"), empty
    )
    fields |= {"element_gain": empty, "element_arm_modulus": empty, "arm_time": _arm_times(spec)}
    fields |= {"steep_sweeps": steep_sweeps(1.0 + float(law.rise.max())), "steep_rise": math.inf}
    fields["stiffens"], fields["relaxes"] = bool(law.rise.any()), bool(law.arm_modulus.any())
    weight, shear = mesh.volumes * spring_modulus, 0.4 * spring_modulus
    if fields["stiffens"]:
        rises = law.rise > 0.0
        onset, width = (
            node_mean(np.divide(amount, law.rise, out=np.zeros_like(amount), where=rises), law.rise * weight)
            for amount in (law.onset, law.width)
        )
        rise = node_mean(law.rise, weight)
        nodes = mesh.edges[springs]
        length = norm(mesh.points[nodes[:, 0]] - mesh.points[nodes[:, 1]], axis=1)
        sums = np.bincount(nodes.ravel(), np.repeat(stiffness * (length * length), 2), mesh.node_count)
        # Young's modulus over that of springs alone, E / (3 mu).
        share = (5.0 * shear + 3.0 * bulk) / (3.0 * (2.0 * shear + bulk))
        fields["node_softness"] = 5.0 / (sums * node_mean(share, weight))
        fields["node_onset"] = onset
        fields["node_growth"] = 1.0 / width
        fields["node_excess"] = rise * width
        fields["spring_hold"] = stiffness * spring_mean(STEEP_HOLD * (1.0 + VOLUME_HOLD * bulk / shear))
        fields["steep_rise"] = _steep_rise(onset, width, rise, nodes)
    if fields["relaxes"]:
        moduli = np.stack([np.concatenate([spring_mean(arm), arm, node_mean(arm, weight)]) for arm in law.arm_modulus])
        fields["element_gain"] = 1.0 + moduli.sum(axis=0)
        fields["element_arm_modulus"] = moduli.ravel()
    return fields


def _steep_rise(onset: FloatArray, width: FloatArray, rise: FloatArray, springs: NDArray[np.int32]) -> float:
    """Lower bound of the relative rise of tension in springs (n, 2) with a tangent raised by STEEP_EXCESS.

    Half the rise of a node, h, is a convex function of its steepness q: it lies above its tangent at q = STEEP_EXCESS,
    of slope m. So the sum for two ends with this mean steepness is at least h1 + h2 - STEEP_EXCESS |m1 - m2|; and at
    least one end has this steepness, so that the sum is at least the lesser h. A node with a lower cap never has it.
    """
    steep = rise > STEEP_EXCESS
    ramp = np.sqrt(STEEP_EXCESS / np.maximum(rise, STEEP_EXCESS))
    strain = onset + ramp * width
    half = np.where(steep, rise * width * (ramp * ramp * ramp) / (6.0 * strain), math.inf)[springs]
    slope = (width * ramp * (3.0 * onset + 2.0 * ramp * width) / (12.0 * (strain * strain)))[springs]
    both = half.sum(axis=1) - STEEP_EXCESS * np.abs(slope[:, 0] - slope[:, 1])
    least = np.where(steep[springs].all(axis=1), np.maximum(both, half.min(axis=1)), half.min(axis=1))
    # Lanes in float32 round.
    return 0.99 * float(least.min(initial=math.inf))


def _arm_times(spec: OrganSpec) -> FloatArray:
    """Times of the Maxwell arms of all materials [s], inf for none, (3,)."""
    materials = [*_materials_by_tag(spec).values(), *(cast(Material, lesion.material) for lesion in spec.lesions)]
    known = {material.relaxation.times for material in materials if material.relaxation is not None}
    if len(known) > 1:
        raise OrganError(
            f"the materials of one organ relax with the times {' and '.join(map(str, sorted(known)))} s; they must "
            "share their times: give each material all of them, with a relative modulus of 0 where it has none"
        )
    times = np.full(ARM_COUNT, np.inf)
    for arm_times in known:
        times[: len(arm_times)] = arm_times
    return times


def relax_arms(model: OrganModel, state: OrganState) -> None:
    """Relax all Maxwell arms fully at the present positions, in place."""
    if not model.relaxes:
        return
    strain = element_strains(model, state.node_position)
    tension = element_tensions(model, strain, node_strains(model, strain))
    state.element_arm_tension[:] = np.tile(tension, ARM_COUNT)
    state.element_relief[:] = (model.element_arm_modulus.reshape(ARM_COUNT, -1) * tension).sum(axis=0)


def _tet_properties(spec: OrganSpec) -> tuple[FloatArray, FloatArray, FloatArray, _TetLaw]:
    """Modulus for the springs [Pa], modulus of the volume term [Pa], density [kg/m^3] and law of each tet."""
    mesh = spec.mesh
    law = _TetLaw.linear(mesh.tet_count)
    spring_modulus = np.empty(mesh.tet_count)
    bulk = np.empty(mesh.tet_count)
    density = np.empty(mesh.tet_count)
    layer = boundary_layer(mesh) if spec.capsule is not None and spec.capsule.thickness is None else None
    for tag, material in _materials_by_tag(spec).items():
        members = slice(None) if tag is None else mesh.region == tag
        spring_modulus[members] = material.spring_modulus
        bulk[members] = material.volume_modulus
        density[members] = material.density
        law.mix(material, 1.0, members)
        if layer is not None:
            stroma = replace(material, youngs_modulus=cast(Capsule, spec.capsule).youngs_modulus)
            in_layer = layer if tag is None else layer & (mesh.region == tag)
            spring_modulus[in_layer] = stroma.spring_modulus
            bulk[in_layer] = stroma.volume_modulus
    for lesion in spec.lesions:
        material = cast(Material, lesion.material)
        fraction = lesion_fraction(mesh, lesion)
        spring_modulus, bulk = mixed_moduli(spring_modulus, bulk, material, fraction)
        density += fraction * (material.density - density)
        law.mix(material, fraction)
    return spring_modulus, bulk, density, law


def _materials_by_tag(spec: OrganSpec) -> dict[int | None, Material]:
    if isinstance(spec.materials, Material):
        return {None: spec.materials}
    mesh = spec.mesh
    by_tag: dict[int | None, Material] = {mesh.region_tag(name): part for name, part in spec.materials.items()}
    missing = sorted(set(np.unique(mesh.region).tolist()) - set(by_tag))
    if missing:
        names = dict(mesh.region_names)
        raise OrganError(
            f"mesh region {names.get(missing[0], missing[0])!r} has no material; "
            "give one for every region in `materials`"
        )
    return by_tag


def _anchor_mask(anchors: ArrayLike, node_count: int) -> NDArray[np.bool_]:
    nodes = np.asarray(anchors)
    mask = np.zeros(node_count, dtype=bool)
    if nodes.size == 0:
        return mask
    if nodes.dtype.kind not in "iu" or nodes.min() < 0 or nodes.max() >= node_count:
        raise OrganError(
            f"anchors are node indices in 0..{node_count - 1}; got {nodes.dtype} from {nodes.min()} to {nodes.max()}"
        )
    mask[nodes] = True
    return mask


def _read_only(array: NDArray) -> NDArray:
    array = np.ascontiguousarray(array)
    if array.flags.writeable:
        array = array.copy() if array.base is not None else array
        array.setflags(write=False)
    return array
