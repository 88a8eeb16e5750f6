"""The chart of a palpable face: places, points and sites belong together."""

from dataclasses import replace

import numpy as np
import pytest

from surgsim_env.palpation.chart import make_chart
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene


def test_the_phantoms_chart_is_its_top_less_the_margin():
    anatomy = load_anatomy(make_scene("phantom"))
    chart = make_chart(anatomy.face, 0.008)
    np.testing.assert_allclose([chart.lower, chart.upper], [[0.010, 0.010], [0.050, 0.050]], atol=1e-12)
    # 40 mm in steps of half a tip's radius are 11 sites; there are at least 13.
    assert chart.side_count == 13
    assert make_chart(anatomy.face, 0.004).side_count == 21
    assert make_chart(anatomy.face, 0.001).side_count == 25
    np.testing.assert_allclose(chart.place([0.030, 0.050, 0.2]), [0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize("scene", ["phantom", "liver"])
def test_places_points_and_sites_are_each_others_inverse(scene: str):
    anatomy = load_anatomy(make_scene(scene))
    chart = make_chart(anatomy.face, anatomy.scene.instrument.tip_radius)
    assert chart.side_count % 2 == 1
    plane = chart.plane_point(chart.sites)
    points = plane[:, :1] * chart.across + plane[:, 1:] * chart.along
    np.testing.assert_allclose(chart.place(points), chart.sites, atol=1e-9)
    assert [chart.site(place) for place in chart.sites] == list(range(chart.side_count**2))
    step = 2.0 / (chart.side_count - 1)
    assert chart.site([-1.0 - 0.49 * step, 1.0]) == chart.side_count**2 - chart.side_count
    assert chart.site([-1.0 - 0.51 * step, 1.0]) is None
    # Every place that a raster of the face allows is on the chart.
    allowed = chart.place(anatomy.face.raster(0.01)[0])
    assert np.abs(allowed).max() <= 1.0 + 1e-9


def test_a_margin_that_leaves_nothing_is_refused():
    anatomy = load_anatomy(make_scene("phantom"))
    wide = replace(anatomy.face, margin=0.031)
    with pytest.raises(ValueError, match=r"face_margin of 31 mm leaves nothing of a palpable face of 60 x 60 mm"):
        make_chart(wide, 0.008)
