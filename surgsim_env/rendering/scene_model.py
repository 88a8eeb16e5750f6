"""The drawn scene as a MuJoCo model of its own: organ, sections, instrument, drape, lights; it never runs."""

from dataclasses import dataclass

import mujoco
import numpy as np

from msdm_core.mesh import FloatArray
from surgsim_env.anatomy import Anatomy
from surgsim_env.palpable_face import tangent_axes
from surgsim_env.rendering.cameras import cut_direction
from surgsim_env.rendering.cutting import SECTION_SPLITS, most_tets_cut
from surgsim_env.rendering.drawn_mesh import DrawnMesh, add_mesh
from surgsim_env.rendering.instrument_geoms import InstrumentGeoms, add_instrument, find_instrument
from surgsim_env.rendering.options import RenderOptions
from surgsim_env.rendering.surface import DrawnSurface


@dataclass(frozen=True)
class Look:
    """Colour (red, green, blue), how strong and how narrow highlights are, and how much it glows by itself."""

    colour: tuple[float, float, float]
    specular: float
    shininess: float
    emission: float = 0.0


# The organ, where it is held by ligaments or a tray, its cut faces, and its shadow on the drape.
LOOKS = {
    "organ": Look((0.455, 0.130, 0.100), 0.75, 0.80),
    "held": Look((0.560, 0.235, 0.185), 0.60, 0.45),
    "section": Look((0.590, 0.235, 0.195), 0.10, 0.20, 0.25),
    "section_lesion": Look((0.980, 0.860, 0.500), 0.10, 0.20, 0.25),
    "shadow": Look((0.055, 0.150, 0.170), 0.0, 0.0),
}
LESION_COLOUR = (0.98, 0.84, 0.42)
TARGET_COLOUR = (0.20, 0.75, 0.35)
# The drape's squares are this wide [m]: a scale to read sizes off.
DRAPE_SQUARE = 0.02
DRAPE_COLOURS = (0.115, 0.315, 0.355), (0.128, 0.345, 0.385)
BACKGROUND_COLOUR = (0.045, 0.105, 0.120)
# Half the drape's width in radii of the organ, and its distance below it [m].
DRAPE_WIDTH, DRAPE_GAP = 10.0, 0.0005
TRANSLUCENT = 0.34
# Clipping planes of the cameras [m].
NEAR, FAR = 0.005, 5.0


@dataclass(frozen=True, eq=False)
class SceneModel:
    """The compiled scene and where to find its parts.

    Fields:
        model, data: MuJoCo's
        meshes: what is set anew for each picture, by name: keys of LOOKS
        instrument: the geoms that follow the instrument
        light: unit direction of the lamp's light                                   (3,)
        ground: a point of the drape [m]                                            (3,)
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    meshes: dict[str, DrawnMesh]
    instrument: InstrumentGeoms
    light: FloatArray
    ground: FloatArray


def build_scene(
    anatomy: Anatomy, surface: DrawnSurface, instrument: mujoco.MjModel, options: RenderOptions
) -> SceneModel:
    """The scene of an anatomy and an instrument's model, with room for what the options ask for."""
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = options.width, options.height
    spec.visual.quality.offsamples = 4 if options.smooth_edges else 0
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = NEAR, FAR
    light = _add_lights(spec, anatomy, options)
    ground = _add_drape(spec, anatomy)
    meshes = _room(anatomy, surface, options)
    for name, (vertices, faces) in meshes.items():
        look = LOOKS[name]
        material = spec.add_material(name=name, specular=look.specular, shininess=look.shininess)
        material.rgba = [*look.colour, TRANSLUCENT if options.show_lesion and name in ("organ", "held") else 1.0]
        material.emission = look.emission
        add_mesh(spec, name, name, vertices, faces)
    add_instrument(spec, instrument)
    spec.worldbody.add_camera(name="view")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    drawn = {name: DrawnMesh(model, name) for name in meshes}
    for mesh in drawn.values():
        data.geom_xpos[mesh.geom] = 0.0
        data.geom_xmat[mesh.geom] = np.eye(3).ravel()
    return SceneModel(model, data, drawn, find_instrument(model, instrument), light, ground)


def _room(anatomy: Anatomy, surface: DrawnSurface, options: RenderOptions) -> dict[str, tuple[int, int]]:
    """The most vertices and triangles that each mesh of the scene may have."""
    many = 2 if options.cut_away else 1
    whole = many * surface.vertex_count, many * len(surface.faces)
    room = {"organ": whole, "held": whole}
    if options.cut_away:
        # A cut tet is a quadrangle at most, whose triangles are split and may each be parted by a lesion's outline.
        small = 2 * SECTION_SPLITS**2 * most_tets_cut(anatomy.mesh, cut_direction(anatomy))
        room |= {"section": (6 * small, 2 * small), "section_lesion": (6 * small, 2 * small)}
    elif not (options.shadows or options.show_lesion or anatomy.scene.supports):
        # Where it rests on something else, that is in the drape's way.
        room["shadow"] = (anatomy.mesh.node_count, len(surface.triangles))
    return room


def _add_lights(spec: mujoco.MjSpec, anatomy: Anatomy, options: RenderOptions) -> FloatArray:
    """A lamp above the surgeon's left shoulder, a faint one from behind, one at the camera; the lamp's direction."""
    up = -anatomy.downward
    across, along = tangent_axes(anatomy.downward)
    directions = {"lamp": (0.30 * along + 0.38 * across - up, 0.60), "rim": (-along - 0.4 * across - 0.5 * up, 0.22)}
    for name, (towards, strength) in directions.items():
        light = spec.worldbody.add_light(name=name, dir=towards / np.linalg.norm(towards))
        light.pos = -0.8 * np.asarray(light.dir)
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        light.castshadow = options.shadows and name == "lamp"
        light.diffuse, light.specular, light.ambient = [strength] * 3, [strength] * 3, [0.0] * 3
    head = spec.visual.headlight
    head.ambient, head.diffuse, head.specular = [0.30] * 3, [0.36] * 3, [0.10] * 3
    towards = directions["lamp"][0]
    return towards / np.linalg.norm(towards)


def _add_drape(spec: mujoco.MjSpec, anatomy: Anatomy) -> FloatArray:
    """A cloth below the organ and what it rests on; a point of it [m].

    A plane that the organ rests on stands in its place.
    """
    points, down = anatomy.mesh.points, anatomy.downward
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    solids = [support for support in anatomy.scene.supports if support.kind != "plane"]
    lowest = max([float((points @ down).max()), *(solid.reach(down) for solid in solids)])
    ground = centre + (lowest + DRAPE_GAP - centre @ down) * down
    # Where a camera sees beyond the drape.
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=16, height=96)
    sky.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
    sky.rgb1 = sky.rgb2 = BACKGROUND_COLOUR
    across, _ = tangent_axes(down)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.column_stack([across, np.cross(-down, across), -down]).ravel())
    cloth = spec.add_texture(name="drape", type=mujoco.mjtTexture.mjTEXTURE_2D, width=64, height=64)
    cloth.builtin = mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    cloth.rgb1, cloth.rgb2 = DRAPE_COLOURS
    material = spec.add_material(name="drape", specular=0.0, shininess=0.0)
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
        contype=0,
        conaffinity=0,
    )
    return ground
