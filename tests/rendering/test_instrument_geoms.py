"""Any instrument's model is drawn: its visible geoms, meshes in their own frames, posed as its data says. No OpenGL."""

import mujoco
import numpy as np
import pytest
import trimesh

from surgsim_env import Port, load_arm
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP
from surgsim_env.rendering.scene_model import add_instrument, find_instrument, shown_geoms


@pytest.fixture
def arm():
    """An arm: a mesh link with a hidden contact capsule, a tip that only tissue feels, a site, geoms nobody shows."""
    spec = mujoco.MjSpec()
    steel = spec.add_material(name="steel", rgba=[0.7, 0.7, 0.8, 1.0])
    steel.specular = 0.25
    shape = trimesh.creation.cone(radius=0.01, height=0.05)
    mesh = spec.add_mesh(name="cone")
    # Far off its own middle, so that MuJoCo's recentring shows; each triangle with corners of its own, as in an STL.
    mesh.uservert = (shape.triangles.reshape(-1, 3) + np.array([0.3, 0.1, 0.0])).ravel()
    mesh.userface = np.arange(3 * len(shape.triangles))
    link = spec.worldbody.add_body(name="link", pos=[0.1, 0.0, 0.2])
    link.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
    link.add_geom(name="visual", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="cone", material="steel", pos=[0, 0, 0.1])
    link.add_geom(name="felt", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.01, 0.05, 0], group=3)
    link.add_geom(name="unseen", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1] * 3, rgba=[1, 0, 0, 0])
    tip = link.add_body(name="tip", pos=[0.0, 0.0, -0.1])
    tip.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.005, 0, 0], group=3, rgba=[0.2, 0.9, 0.2, 1])
    tip.add_geom(name="collar", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.006, 0.001, 0], group=1)
    tip.add_geom(name="helper", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], group=4)
    return spec.compile()


def test_visible_geoms_are_shown_and_felt_ones_where_no_mesh_stands_for_them(arm):
    assert [arm.geom(geom).name for geom in shown_geoms(arm)] == ["visual", "ball", "collar"]


def test_drawn_where_and_as_the_instrument_is(arm):
    """World positions of the mesh's corners and normals, and of the ball, with the joint turned."""
    data = mujoco.MjData(arm)
    data.qpos[0] = 0.7
    mujoco.mj_forward(arm, data)
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="other", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1] * 3)
    add_instrument(spec, arm)
    drawn = spec.compile()
    shown = mujoco.MjData(drawn)
    geoms = find_instrument(drawn, arm)
    geoms.pose(data, shown)
    assert len(geoms.source) == 3

    def world(model, state, geom):
        mesh = model.geom_dataid[geom]
        rows = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
        faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
        rotation = state.geom_xmat[geom].reshape(3, 3)
        corners = model.mesh_vert[rows][model.mesh_face[faces]] @ rotation.T + state.geom_xpos[geom]
        first = model.mesh_normaladr[mesh]
        normals = model.mesh_normal[first + model.mesh_facenormal[faces]] @ rotation.T
        return corners, normals

    for own, copy in zip(world(arm, data, geoms.source[0]), world(drawn, shown, geoms.target[0]), strict=True):
        np.testing.assert_allclose(copy, own, atol=1e-6)
    np.testing.assert_array_equal(shown.geom_xpos[geoms.target[1]], data.geom("ball").xpos)
    assert drawn.geom_size[geoms.target[1], 0] == 0.005
    np.testing.assert_allclose(drawn.geom_rgba[geoms.target[0]], [0.7, 0.7, 0.8, 1.0], atol=1e-6)
    np.testing.assert_allclose(drawn.geom_rgba[geoms.target[1]], [0.2, 0.9, 0.2, 1.0], atol=1e-6)
    assert drawn.mat_specular[drawn.geom_matid[geoms.target[0]]] == 0.25


@pytest.mark.parametrize("name", ["psm_palpator", "psm_grasper", "six_axis"])
def test_all_that_tissue_feels_of_an_arm_is_shown(name: str):
    model = load_arm(name, Port()).model
    shown = {model.geom(geom).name for geom in shown_geoms(model)}
    felt = {model.geom(geom).name for geom in np.flatnonzero(model.geom_group == CONTACT_GROUP)}
    assert len(felt) > 2 and felt <= shown
