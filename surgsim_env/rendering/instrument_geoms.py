"""Geoms of an instrument, and of supports in its model, in the drawn scene."""

from dataclasses import dataclass

import mujoco
import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP, SUPPORT_PREFIX

PREFIX = "instrument"
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
_DRAWN_TYPES = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("SPHERE", "CAPSULE", "ELLIPSOID")} | {
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("CYLINDER", "BOX", "MESH")
}
# MuJoCo's default colour of a geom: the colour of its material counts then.
_NO_COLOUR = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)


@dataclass(frozen=True, eq=False)
class InstrumentGeoms:
    """Geoms of an instrument's model that are drawn, and their geoms in the drawn scene.

    Fields:
        source: geoms of the instrument's model                                     (n_geom,)
        target: geoms of the drawn scene                                            (n_geom,)
    """

    source: np.ndarray
    target: np.ndarray

    def pose(self, data: mujoco.MjData, drawn: mujoco.MjData) -> None:
        """Copy the poses of the instrument's geoms to the drawn ones."""
        drawn.geom_xpos[self.target] = data.geom_xpos[self.source]
        drawn.geom_xmat[self.target] = data.geom_xmat[self.source]


def shown_geoms(model: mujoco.MjModel) -> list[int]:
    """Geoms to draw: the visible ones (groups 0 to 2), and contact geoms of bodies without a visible mesh."""
    shown = []
    is_mesh = model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH)
    dressed = set(model.geom_bodyid[is_mesh & (model.geom_group < CONTACT_GROUP)].tolist())
    for geom in range(model.ngeom):
        group, body = int(model.geom_group[geom]), int(model.geom_bodyid[geom])
        wanted = group < CONTACT_GROUP or (group == CONTACT_GROUP and body not in dressed)
        if wanted and _is_drawn(model, geom) and geom_colour(model, geom)[3] > 0.0:
            shown.append(geom)
    return shown


def add_instrument(spec: mujoco.MjSpec, model: mujoco.MjModel, prefix: str = PREFIX) -> None:
    """Add every geom that is shown, and the meshes and materials of these; names in the scene begin with `prefix`."""
    for geom in shown_geoms(model):
        kind = int(model.geom_type[geom])
        added = spec.worldbody.add_geom(
            name=_name(model, geom, prefix),
            type=mujoco.mjtGeom(kind),
            rgba=geom_colour(model, geom),
            material=_cloth(spec)
            if _is_support(model, geom)
            else _material(spec, model, int(model.geom_matid[geom]), prefix),
            contype=0,
            conaffinity=0,
        )
        if kind == _MESH:
            added.meshname = _mesh(spec, model, int(model.geom_dataid[geom]), prefix)
        else:
            added.size = model.geom_size[geom]


def find_instrument(drawn: mujoco.MjModel, model: mujoco.MjModel, prefix: str = PREFIX) -> InstrumentGeoms:
    """The geoms that `add_instrument` added, in the compiled scene; their meshes get the instrument's own frames."""
    source = shown_geoms(model)
    for mesh in {int(model.geom_dataid[geom]) for geom in source if model.geom_type[geom] == _MESH}:
        target = drawn.mesh(f"{prefix}_mesh_{mesh}").id
        _slice(drawn, target, "vert")[:] = _slice(model, mesh, "vert")
        _slice(drawn, target, "normal")[:] = _slice(model, mesh, "normal")
    return InstrumentGeoms(
        source=np.array(source, dtype=np.int64),
        target=np.array([drawn.geom(_name(model, geom, prefix)).id for geom in source], dtype=np.int64),
    )


def _is_drawn(model: mujoco.MjModel, geom: int) -> bool:
    return int(model.geom_type[geom]) in _DRAWN_TYPES or _is_support(model, geom)


def _is_support(model: mujoco.MjModel, geom: int) -> bool:
    return int(model.geom_bodyid[geom]) == 0 and model.geom(geom).name.startswith(SUPPORT_PREFIX)


def _name(model: mujoco.MjModel, geom: int, prefix: str) -> str:
    """A geom's name in the drawn scene: what begins with PREFIX is labelled as the instrument, supports are not."""
    return f"{SUPPORT_PREFIX if _is_support(model, geom) else f'{prefix}_'}{geom}"


def _cloth(spec: mujoco.MjSpec) -> str:
    """The material of supports, which is matt."""
    name = f"{SUPPORT_PREFIX}material"
    if spec.material(name) is None:
        spec.add_material(name=name, specular=0.0, shininess=0.0)
    return name


def geom_colour(model: mujoco.MjModel, geom: int) -> FloatArray:
    """Red, green, blue and opacity of a geom, its material's where it has none of its own, shape (4,)."""
    colour, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    if material >= 0 and np.array_equal(colour, _NO_COLOUR):
        colour = model.mat_rgba[material]
    return colour.astype(np.float64)


def _material(spec: mujoco.MjSpec, model: mujoco.MjModel, material: int, prefix: str) -> str:
    """A material like the instrument's own; polished metal where it has none."""
    name = f"{prefix}_material_{material}"
    if spec.material(name) is None:
        added = spec.add_material(name=name, specular=0.9, shininess=0.7)
        if material >= 0:
            added.specular = float(model.mat_specular[material])
            added.shininess = float(model.mat_shininess[material])
            added.emission = float(model.mat_emission[material])
    return name


def _mesh(spec: mujoco.MjSpec, model: mujoco.MjModel, mesh: int, prefix: str) -> str:
    name = f"{prefix}_mesh_{mesh}"
    if spec.mesh(name) is None:
        added = spec.add_mesh(name=name)
        added.uservert = _slice(model, mesh, "vert").ravel()
        added.usernormal = _slice(model, mesh, "normal").ravel()
        first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        added.userface = model.mesh_face[first : first + count].ravel()
        added.userfacenormal = model.mesh_facenormal[first : first + count].ravel()
        added.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    return name


def _slice(model: mujoco.MjModel, mesh: int, what: str) -> FloatArray:
    """The rows of one mesh in mesh_vert or mesh_normal."""
    first = int(getattr(model, f"mesh_{what}adr")[mesh])
    return getattr(model, f"mesh_{what}")[first : first + int(getattr(model, f"mesh_{what}num")[mesh])]
