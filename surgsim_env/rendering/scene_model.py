"""Drawn scene as a MuJoCo model of its own, never simulated: organ, sections, instrument, drape, lights."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP, SUPPORT_PREFIX
from surgsim_env.rendering import abdomen
from surgsim_env.rendering.cameras import cut_direction
from surgsim_env.rendering.embedding import EmbeddedSurface
from surgsim_env.rendering.endoscopic import TISSUE_LENGTH
from surgsim_env.rendering.options import RenderOptions
from surgsim_env.rendering.painted_fields import field_colours
from surgsim_env.rendering.surface import DrawnSurface, Shape
from surgsim_env.rendering.tissue import SECTION_SPLITS, most_tets_cut
from surgsim_env.rendering.vessels import TEXTURE_SIZE, texture_places
from surgsim_env.scene.anatomy import Anatomy
from surgsim_env.scene.palpable_surface import tangent_axes

Colour = tuple[float, float, float]
# Name of the mesh of an abdomen.
ABDOMEN = "abdomen"


# Prefix of the names of an instrument's geoms.
PREFIX = "instrument"
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
_DRAWN_TYPES = {
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
}
# MuJoCo's default colour of a geom, replaced by the colour of its material.
_NO_COLOUR = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)


@dataclass(frozen=True)
class Finish:
    """Colour (red, green, blue), strength and narrowness of highlights, and emitted light of a material."""

    colour: Colour
    specular: float
    shininess: float
    emission: float = 0.0


# The organ, its part held by ligaments or a tray, its cut faces, and its shadow on the drape.
FINISHES = {
    "organ": Finish((0.455, 0.130, 0.100), 0.75, 0.80),
    "held": Finish((0.560, 0.235, 0.185), 0.60, 0.45),
    "section": Finish((0.590, 0.235, 0.195), 0.10, 0.20, 0.25),
    "section_lesion": Finish((0.980, 0.860, 0.500), 0.10, 0.20, 0.25),
    "shadow": Finish((0.055, 0.150, 0.170), 0.0, 0.0),
    ABDOMEN: Finish((0.7, 0.5, 0.3), 0.0, 0.0),
}
LESION_COLOUR = (0.98, 0.84, 0.42)
TARGET_COLOUR = (0.20, 0.75, 0.35)
# Width of the drape's squares [m], a scale for the eye.
DRAPE_SQUARE = 0.02
DRAPE_COLOURS = (0.115, 0.315, 0.355), (0.128, 0.345, 0.385)
BACKGROUND_COLOUR = (0.045, 0.105, 0.120)
# Half the drape's width in radii of the organ, and its distance below the organ [m].
DRAPE_WIDTH, DRAPE_GAP = 10.0, 0.0005
TRANSLUCENT = 0.34
# Tissue on which fields are painted, and the colour that multiplies theirs: the lights add up to more than 1.
PAINTED, PAINTED_COLOUR = ("organ", "held", "section", "section_lesion"), (0.78, 0.78, 0.78)
# Supports in endoscopic pictures, like the wall of the abdomen.
SUPPORT_COLOUR = (0.66, 0.36, 0.31)
# Groups of geoms in endoscopic pictures: seen in colour alone, and in depth and labels alone.
SCENERY_GROUP, DRAPE_GROUP = 4, 5
# Name of the texture of vessels or a field, white until a look draws them.
VESSELS = "vessels"
# Clipping planes of the cameras [m].
NEAR, FAR = 0.005, 5.0
# MuJoCo accepts no empty or flat mesh: before the first picture a mesh consists of copies of this tetrahedron.
_TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.01]])
_TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)


class DrawnMesh:
    """Mesh of a compiled model with a new shape for each picture."""

    def __init__(self, model: mujoco.MjModel, name: str, *, is_solid: bool = False) -> None:
        # The endoscopic style wants the resting places of solid tissue.
        self._model, self._is_solid = model, is_solid
        self.mesh = model.mesh(name).id
        self.geom = model.geom(name).id
        self._face_count = int(model.mesh_facenum[self.mesh])

    def upload(self, shape: Shape, context: mujoco.MjrContext) -> None:
        """Replace the shape of the mesh, in the world's axes."""
        model, mesh, count = self._model, self.mesh, len(shape.vertices)
        normals, face_places = shape.normals, shape.face_places
        if self._is_solid and shape.rest is not None:
            first_place = model.mesh_texcoordadr[mesh]
            model.mesh_texcoord[first_place : first_place + count] = shape.rest[:, :2]
            normals, face_places = normals * (TISSUE_LENGTH + shape.rest[:, 2:]), shape.faces
        for array, address, values in (
            (model.mesh_vert, model.mesh_vertadr, shape.vertices),
            (model.mesh_normal, model.mesh_normaladr, normals),
        ):
            array[address[mesh] : address[mesh] + count] = values
        first = model.mesh_faceadr[mesh]
        for array in (model.mesh_face, model.mesh_facenormal):
            array[first : first + len(shape.faces)] = shape.faces
        if shape.shares is not None:
            # The second half of the texture leads back.
            first_place = model.mesh_texcoordadr[mesh]
            model.mesh_texcoord[first_place : first_place + count, 0] = 0.5 * shape.shares
        if face_places is not None:
            model.mesh_facetexcoord[first : first + len(shape.faces)] = face_places
        self._face_count = len(shape.faces)
        self.show(True, context)

    def show(self, shown: bool, context: mujoco.MjrContext) -> None:
        """Show the mesh in the next pictures, or hide it."""
        self._model.mesh_facenum[self.mesh] = self._face_count if shown else 0
        mujoco.mjr_uploadMesh(self._model, context, self.mesh)


@dataclass(frozen=True, eq=False)
class InstrumentGeoms:
    """Drawn geoms of an instrument's model and their copies in the drawn scene.

    Fields:
        source: ids in the instrument's model                                       (n_geom,)
        target: ids in the drawn scene                                              (n_geom,)
    """

    source: np.ndarray
    target: np.ndarray

    def pose(self, data: mujoco.MjData, drawn: mujoco.MjData) -> None:
        """Copy the poses of the instrument's geoms to the drawn ones."""
        drawn.geom_xpos[self.target] = data.geom_xpos[self.source]
        drawn.geom_xmat[self.target] = data.geom_xmat[self.source]


@dataclass(frozen=True, eq=False)
class SceneModel:
    """Compiled scene and its parts.

    Fields:
        model, data: MuJoCo's
        meshes: of tissue and shadow, by their names in FINISHES
        instrument: geoms of the instrument
        light: unit direction of the lamp's light                                   (3,)
        ground: a point of the drape [m]                                            (3,)
        downward: unit direction of the instruments' approach                       (3,)
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    meshes: dict[str, DrawnMesh]
    instrument: InstrumentGeoms
    light: FloatArray
    ground: FloatArray
    downward: FloatArray


def build_scene(
    anatomy: Anatomy, surface: DrawnSurface | EmbeddedSurface, instrument: mujoco.MjModel, options: RenderOptions
) -> SceneModel:
    """Scene of an anatomy and an instrument's model, with the meshes needed by the options."""
    spec = empty_scene(options.width, options.height, BACKGROUND_COLOUR, samples=4 if options.smooth_edges else 0)
    light = add_lights(spec, anatomy.downward)
    ground = _add_drape(spec, anatomy)
    meshes = _room(anatomy, surface, options)
    places = None if options.cut_away else texture_places(surface.follow(anatomy.mesh.points)[0], surface.faces)[0]
    if options.paint is not None or options.style == "endoscopic":
        # Room for a place of each vertex on the scale, or at rest, in all shapes.
        places = np.zeros((max(room[0] for room in meshes.values()), 2), dtype=np.float32)
    vessels = spec.add_texture(name=VESSELS, type=mujoco.mjtTexture.mjTEXTURE_2D, width=TEXTURE_SIZE)
    vessels.height, vessels.builtin = TEXTURE_SIZE, mujoco.mjtBuiltin.mjBUILTIN_FLAT
    vessels.rgb1 = vessels.rgb2 = [1.0, 1.0, 1.0]
    for name, (vertices, faces) in meshes.items():
        whole = name in ("organ", "held")
        opacity = TRANSLUCENT if options.show_lesion and whole and options.style == "plain" else 1.0
        textured = whole or name == ABDOMEN or options.paint is not None
        add_tissue(spec, name, vertices, faces, opacity, places if textured else None)
    if ABDOMEN in meshes:
        spec.geom(ABDOMEN).group = SCENERY_GROUP
    add_instrument(spec, instrument)
    model, data, drawn = compile_scene(spec, meshes, is_solid=options.style == "endoscopic")
    geoms = find_instrument(model, instrument)
    if options.paint is not None:
        _paint(model, geoms)
    if options.style == "endoscopic":
        for geom in geoms.target:
            if model.geom(geom).name.startswith(SUPPORT_PREFIX):
                model.geom_rgba[geom, :3] = SUPPORT_COLOUR
    return SceneModel(model, data, drawn, geoms, light, ground, anatomy.downward)


def _paint(model: mujoco.MjModel, instrument: InstrumentGeoms) -> None:
    """Give tissue the colours of a scale as a texture; the instrument before it becomes translucent."""
    texture, there = model.texture(VESSELS), field_colours(TEXTURE_SIZE // 2)
    # There and back, since textures repeat.
    rows = np.tile(np.concatenate([there, there[::-1]]), (TEXTURE_SIZE, 1))
    model.tex_data[texture.adr[0] :][: rows.size] = rows.ravel()
    for name in PAINTED:
        material = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_MATERIAL, name)
        if material >= 0:
            model.mat_rgba[material, :3] = PAINTED_COLOUR
            model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture.id
    model.geom_rgba[instrument.target, 3] = TRANSLUCENT


def empty_scene(width: int, height: int, background: Colour, *, samples: int = 4, far: float = FAR) -> mujoco.MjSpec:
    """Scene with a camera and a background alone; `far` is the far clipping plane [m]."""
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.quality.offsamples = samples
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = NEAR, far
    # Visible beyond all geoms.
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=16, height=96)
    sky.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
    sky.rgb1 = sky.rgb2 = background
    spec.worldbody.add_camera(name="view")
    return spec


def add_tissue(
    spec: mujoco.MjSpec,
    name: str,
    vertex_count: int,
    face_count: int,
    opacity: float = 1.0,
    texture_places: NDArray[np.float32] | None = None,
) -> None:
    """Add a mesh with the finish of its name, with space for `vertex_count` vertices and `face_count` triangles.

    Texture places (n_place, 2) let its triangles be textured.
    """
    finish = FINISHES[name]
    material = spec.add_material(name=name, specular=finish.specular, shininess=finish.shininess)
    material.rgba = [*finish.colour, opacity]
    material.emission = finish.emission
    corner = np.resize(np.arange(4), max(vertex_count, 4))
    faces = np.resize(_TETRAHEDRON_FACES.ravel(), 3 * max(face_count, 4))
    mesh = spec.add_mesh(name=name)
    mesh.uservert = _TETRAHEDRON[corner].ravel()
    mesh.usernormal = np.resize([0.0, 0.0, 1.0], 3 * len(corner))
    mesh.userface = faces
    mesh.userfacenormal = faces
    if texture_places is not None:
        mesh.usertexcoord = texture_places.ravel()
        mesh.userfacetexcoord = np.zeros_like(faces)
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, contype=0, conaffinity=0
    )


def compile_scene(
    spec: mujoco.MjSpec, meshes: Iterable[str], *, is_solid: bool = False
) -> tuple[mujoco.MjModel, mujoco.MjData, dict[str, DrawnMesh]]:
    """Compile a scene: its model, its data, and its meshes by name, in the world's axes."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    drawn = {name: DrawnMesh(model, name, is_solid=is_solid) for name in meshes}
    for mesh in drawn.values():
        data.geom_xpos[mesh.geom] = 0.0
        data.geom_xmat[mesh.geom] = np.eye(3).ravel()
    return model, data, drawn


def _room(
    anatomy: Anatomy, surface: DrawnSurface | EmbeddedSurface, options: RenderOptions
) -> dict[str, tuple[int, int]]:
    """Largest number of vertices and of triangles of each mesh in the scene."""
    copies = 2 if options.cut_away else 1
    whole = copies * surface.vertex_count, copies * len(surface.faces)
    room = {"organ": whole, "held": whole}
    if options.cut_away:
        # A tet is cut in a quadrangle at most; its triangles are split, and a lesion's outline may divide each of them.
        small = 2 * SECTION_SPLITS**2 * most_tets_cut(anatomy.mesh, cut_direction(anatomy))
        room |= {"section": (6 * small, 2 * small), "section_lesion": (6 * small, 2 * small)}
    elif not (options.style == "endoscopic" or options.show_lesion or anatomy.scene.supports):
        # An organ on supports does not lie on the drape and casts no shadow on it.
        room["shadow"] = (anatomy.mesh.node_count, len(anatomy.mesh.boundary_triangles))
    if options.style == "endoscopic":
        room[ABDOMEN] = abdomen.VERTEX_COUNT, abdomen.FACE_COUNT
    return room


def add_lights(spec: mujoco.MjSpec, down: FloatArray) -> FloatArray:
    """Add a lamp above the surgeon's left shoulder, a faint one behind and one at the camera; the lamp's direction."""
    up = -down
    across, along = tangent_axes(down)
    directions = {"lamp": (0.30 * along + 0.38 * across - up, 0.60), "rim": (-along - 0.4 * across - 0.5 * up, 0.22)}
    for name, (towards, strength) in directions.items():
        light = spec.worldbody.add_light(name=name, dir=towards / np.linalg.norm(towards))
        light.pos = -0.8 * np.asarray(light.dir)
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        light.castshadow = False
        light.diffuse, light.specular, light.ambient = [strength] * 3, [strength] * 3, [0.0] * 3
    head = spec.visual.headlight
    head.ambient, head.diffuse, head.specular = [0.30] * 3, [0.36] * 3, [0.10] * 3
    towards = directions["lamp"][0]
    return towards / np.linalg.norm(towards)


def _add_drape(spec: mujoco.MjSpec, anatomy: Anatomy) -> FloatArray:
    """Add a cloth below the organ and its supports; returns a point of it [m].

    A plane that supports the organ replaces it.
    """
    points, down = anatomy.mesh.points, anatomy.downward
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    solids = [support for support in anatomy.scene.supports if support.kind != "plane"]
    lowest = max([float((points @ down).max()), *(solid.reach(down) for solid in solids)])
    ground = centre + (lowest + DRAPE_GAP - centre @ down) * down
    across, _ = tangent_axes(down)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.column_stack([across, np.cross(-down, across), -down]).ravel())
    cloth = spec.add_texture(name="drape", type=mujoco.mjtTexture.mjTEXTURE_2D, width=64, height=64)
    cloth.builtin = mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    # Relative to the lighter squares: they have the material's colour.
    cloth.rgb1, cloth.rgb2 = np.divide(DRAPE_COLOURS, DRAPE_COLOURS[1])
    material = spec.add_material(name="drape", specular=0.0, shininess=0.0)
    material.rgba = [*DRAPE_COLOURS[1], 1.0]
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "drape"
    # A uniform texture repeats for each metre; one repeat holds two squares.
    material.texuniform, material.texrepeat = True, [0.5 / DRAPE_SQUARE, 0.5 / DRAPE_SQUARE]
    if len(solids) < len(anatomy.scene.supports):
        return ground
    spec.worldbody.add_geom(
        name="drape",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=ground,
        quat=quaternion,
        size=[DRAPE_WIDTH * radius, DRAPE_WIDTH * radius, 0.1],
        material="drape",
        group=DRAPE_GROUP,
        contype=0,
        conaffinity=0,
    )
    return ground


def shown_geoms(model: mujoco.MjModel) -> list[int]:
    """Geoms to be drawn: groups 0 to 2, and contact geoms of bodies without a visible mesh."""
    shown = []
    is_mesh = model.geom_type == _MESH
    dressed = set(model.geom_bodyid[is_mesh & (model.geom_group < CONTACT_GROUP)].tolist())
    for geom in range(model.ngeom):
        group, body = int(model.geom_group[geom]), int(model.geom_bodyid[geom])
        wanted = group < CONTACT_GROUP or (group == CONTACT_GROUP and body not in dressed)
        has_shape = int(model.geom_type[geom]) in _DRAWN_TYPES or is_support(model, geom)
        if wanted and has_shape and geom_colour(model, geom)[3] > 0.0:
            shown.append(geom)
    return shown


def add_instrument(spec: mujoco.MjSpec, model: mujoco.MjModel, prefix: str = PREFIX) -> None:
    """Add the shown geoms of a model with their meshes and materials; names in the scene begin with `prefix`."""
    for geom in shown_geoms(model):
        kind = int(model.geom_type[geom])
        added = spec.worldbody.add_geom(
            name=_name(model, geom, prefix),
            type=mujoco.mjtGeom(kind),
            rgba=geom_colour(model, geom),
            material=_cloth(spec)
            if is_support(model, geom)
            else _material(spec, model, int(model.geom_matid[geom]), prefix),
            contype=0,
            conaffinity=0,
        )
        if kind == _MESH:
            added.meshname = _mesh(spec, model, int(model.geom_dataid[geom]), prefix)
        else:
            added.size = model.geom_size[geom]


def find_instrument(drawn: mujoco.MjModel, model: mujoco.MjModel, prefix: str = PREFIX) -> InstrumentGeoms:
    """Geoms of `add_instrument` in the compiled scene; their meshes get the instrument's own frames."""
    source = shown_geoms(model)
    for mesh in {int(model.geom_dataid[geom]) for geom in source if model.geom_type[geom] == _MESH}:
        target = drawn.mesh(f"{prefix}_mesh_{mesh}").id
        mesh_rows(drawn, target, "vert")[:] = mesh_rows(model, mesh, "vert")
        mesh_rows(drawn, target, "normal")[:] = mesh_rows(model, mesh, "normal")
    return InstrumentGeoms(
        source=np.array(source, dtype=np.int64),
        target=np.array([drawn.geom(_name(model, geom, prefix)).id for geom in source], dtype=np.int64),
    )


def is_support(model: mujoco.MjModel, geom: int) -> bool:
    """True if a geom is a support of the organ."""
    body = int(model.geom_bodyid[geom])
    in_world = body == 0 or model.body_mocapid[body] >= 0
    return in_world and model.geom(geom).name.startswith(SUPPORT_PREFIX)


def _name(model: mujoco.MjModel, geom: int, prefix: str) -> str:
    """Name of a geom in the drawn scene; PREFIX labels it as the instrument, supports have another."""
    return f"{SUPPORT_PREFIX if is_support(model, geom) else f'{prefix}_'}{geom}"


def _cloth(spec: mujoco.MjSpec) -> str:
    """Matt material of supports."""
    name = f"{SUPPORT_PREFIX}material"
    if spec.material(name) is None:
        spec.add_material(name=name, specular=0.0, shininess=0.0)
    return name


def geom_colour(model: mujoco.MjModel, geom: int) -> FloatArray:
    """Red, green, blue and opacity of a geom, its material's if it has none of its own, shape (4,)."""
    colour, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    if material >= 0 and np.array_equal(colour, _NO_COLOUR):
        colour = model.mat_rgba[material]
    return colour.astype(np.float64)


def _material(spec: mujoco.MjSpec, model: mujoco.MjModel, material: int, prefix: str) -> str:
    """Material like the instrument's own; polished metal if it has none."""
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
        added.uservert = mesh_rows(model, mesh, "vert").ravel()
        added.usernormal = mesh_rows(model, mesh, "normal").ravel()
        first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        added.userface = mesh_rows(model, mesh, "face").ravel()
        added.userfacenormal = model.mesh_facenormal[first : first + count].ravel()
        added.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    return name


def mesh_rows(model: mujoco.MjModel, mesh: int, kind: str) -> NDArray[Any]:
    """Rows of one mesh in mesh_vert, mesh_normal or mesh_face (kind "vert", "normal", "face"), shape (n, 3)."""
    first = int(getattr(model, f"mesh_{kind}adr")[mesh])
    return getattr(model, f"mesh_{kind}")[first : first + int(getattr(model, f"mesh_{kind}num")[mesh])]
