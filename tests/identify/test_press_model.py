"""The forward model is the organ: what cancels, what stiffens, and how far another mesh differs."""

from dataclasses import replace

import numpy as np
import pytest

from msdm_core import ContactLaw, Material, OrganSpec, box_mesh, compile_organ, rest_state, stable_dt
from msdm_core.material.regions import Damping
from msdm_core.organ.stepping import advance, round_shapes
from surgsim_apps.identify import press_model
from surgsim_apps.identify.identification import IdentifyOptions, identify
from surgsim_apps.identify.press_model import CONTACT_STIFFNESS, PressSetting, PressShape, press_block
from surgsim_apps.identify.recordings import Recording, SitePress
from surgsim_apps.identify.site_fit import GRID_COUNT, SampledCurve, SiteSamples, fit_sites
from tests.identify.made import recording, truth

SETTING = PressSetting(depth=2.5e-3)
LAW = PressShape(0.012, 0.1, 0.2, 30.0)
DEPTHS = np.linspace(0.5e-3, 2.5e-3, 9)


def coarse(shape, setting=SETTING):
    return press_block(shape, setting, cells_to_radius=2)


def test_the_modulus_cancels(monkeypatch):
    soft = coarse(LAW).at(DEPTHS)
    monkeypatch.setattr(press_model, "MODULUS", 8000.0)
    # The same steps in other units of time, but for the tolerance of the stable step's eigenvalue.
    np.testing.assert_allclose(coarse(LAW).at(DEPTHS), soft, rtol=2e-3)


def test_the_law_begins_late_and_stiffens_the_press():
    linear, stiff = coarse(PressShape(0.012)).at(DEPTHS), coarse(LAW).at(DEPTHS)
    assert (np.diff(linear) > 0.0).all() and (np.diff(stiff) > 0.0).all()
    ratio = stiff / linear
    assert ratio[0] == pytest.approx(1.0, abs=0.1)
    assert ratio[-1] > 1.3
    # Without a rise of the tangent the law is the linear one, whatever its strains.
    assert PressShape(0.012, 0.1, 0.2, 1.0).material(1e3, 0.45).stiffening is None


def test_strain_rises_with_depth_and_has_no_scale(monkeypatch):
    """All lengths twice as large, with half the pressure per penetration: the same strain at each depth."""
    strain = coarse(LAW).strain
    assert strain[0] == 0.0 and (np.diff(strain) > 0.0).all() and LAW.onset_strain < strain[-1] < 0.6
    monkeypatch.setattr(press_model, "CONTACT_STIFFNESS", 0.5 * CONTACT_STIFFNESS)
    twice = coarse(replace(LAW, thickness=0.024), PressSetting(2.0 * SETTING.ball_radius, 2.0 * SETTING.depth))
    # But for the tolerance of the stable step's eigenvalue, and the first knots' approach to rest.
    np.testing.assert_allclose(twice.strain, strain, rtol=2e-3, atol=1e-5)


def test_thin_tissue_is_stiffer():
    assert (coarse(PressShape(0.008)).at(DEPTHS) > 1.1 * coarse(PressShape(0.016)).at(DEPTHS))[2:].all()


def test_a_curve_is_zero_above_the_surface_and_not_finite_beyond_its_end():
    curve = coarse(PressShape(0.012))
    assert curve.at(np.array([-1e-3, 0.0])).tolist() == [0.0, 0.0]
    assert np.isnan(curve.at(np.array([3e-3])))


def as_samples(curve):
    """A curve as a recorded press of ten samples."""
    depth = np.linspace(0.25e-3, 2.5e-3, 10)
    press = SitePress(0, np.zeros(3), depth, 5000.0 * curve.at(depth))
    return SiteSamples.of([press], 0.3e-3)


def sampled(curve):
    grid = np.linspace(0.0, curve.depth[-1], GRID_COUNT)
    return SampledCurve(curve.depth[-1], curve.at(grid) ** (2.0 / 3.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape",
    [
        pytest.param(
            PressShape(0.012),
            marks=pytest.mark.xfail(strict=True, reason="measured 5 % at the shallowest sample and 3.5 % at the next"),
            id="linear",
        ),
        pytest.param(
            LAW, marks=pytest.mark.xfail(strict=True, reason="measured 4.0 % at the shallowest deep sample"), id="law"
        ),
    ],
)
def test_a_finer_mesh_has_the_same_shape_of_curve(shape):
    """After its own modulus and offset, as every recorded site has; cells of 1.6 and 1.1 mm."""
    deeper = replace(SETTING, depth=3e-3)
    fits = fit_sites(sampled(press_block(shape, deeper)), as_samples(press_block(shape, deeper, cells_to_radius=6)))
    assert fits.deep_errors.max() < 0.03
    assert fits.modulus[0] == pytest.approx(5000.0, rel=0.06)


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="measured 3.002 % at the shallowest deep sample")
def test_the_full_organ_has_the_same_curve():
    """An organ of liver's density and modulus on cells of 1.2 mm, the ball off the nodes, pressed by `advance`."""
    mesh = box_mesh((0.036, 0.036, 0.012), (30, 30, 10))
    model = compile_organ(
        OrganSpec(
            mesh,
            Material(5000.0, 1060.0, 0.45, stiffening=LAW.material(5000.0, 0.45).stiffening),
            anchors=np.flatnonzero(mesh.points[:, 2] < 1e-9),
            damping=Damping(alpha=150.0),
        )
    )
    law = ContactLaw(CONTACT_STIFFNESS * 5000.0, 0.0, 0.0, 0.0)
    step, moving, holding = 1e-3, 15, 60
    count = int(np.ceil(step / (0.9 * stable_dt(model, law))))
    state = rest_state(model, shape_count=1)
    centre = np.array([0.0184, 0.0182, 0.012 + SETTING.ball_radius])
    shapes = round_shapes([[centre, centre]], SETTING.ball_radius)
    forces = []
    for travel in np.diff(DEPTHS, prepend=0.0):
        for velocity, steps in ((-travel / (moving * step), moving), (0.0, holding)):
            shapes.tool_twist[0, 2] = velocity
            for _ in range(steps):
                wrench = advance(model, state, dt=step / count, substep_count=count, shapes=shapes, contact=law)
        forces.append(wrench[0, 2])
    samples = SiteSamples.of([SitePress(0, np.zeros(3), DEPTHS, np.array(forces))], 0.3e-3)
    fits = fit_sites(sampled(press_block(LAW, replace(SETTING, depth=3e-3))), samples)
    assert fits.deep_errors.max() < 0.03
    assert fits.modulus[0] == pytest.approx(5000.0, rel=0.06)


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="measured a modulus of 0.81 of the truth: the mesh's cells are felt")
def test_tissue_made_by_the_organ_on_another_mesh_is_identified():
    """A law that the command does not know, on cells of 1.3 mm, with 1 % of noise; thickness given."""
    curve = press_block(LAW, PressSetting(depth=4.2e-3), cells_to_radius=5)
    made = recording(lambda depth: curve.at(depth), noise=0.01)
    result = identify([Recording("made", made.presses)], IdentifyOptions(thickness=0.012))
    (dataset,) = result.sets
    assert not result.is_linear
    assert dataset.error.median < 0.02 < 0.06 < dataset.linear_error.median
    assert np.median(dataset.fits.modulus / truth()[0]) == pytest.approx(1.0, abs=0.1)
    # The tension in the strains under the ball is identifiable, its numbers are not.
    strains = np.array([0.05, 0.1, 0.15, 0.2, 0.25])
    material, wanted = (shape.material(1e3, 0.45).stiffening for shape in (result.shape, LAW))
    np.testing.assert_allclose(material.tension(strains), wanted.tension(strains), rtol=0.25)
