"""The chart of a palpable face: places, points and sites belong together."""

from dataclasses import replace

import numpy as np
import pytest

from surgsim_env.palpation.chart import (
    MAP_SIDE,
    ChartedFace,
    HealthyMap,
    _shipped,
    charted_face,
    healthy_file,
    make_chart,
    map_digest,
)
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.load import make_scene, with_instrument


def test_the_phantoms_chart_is_its_top_less_the_margin():
    anatomy = load_anatomy(make_scene("phantom"))
    chart = make_chart(anatomy.face, 0.008)
    np.testing.assert_allclose([chart.lower, chart.upper], [[0.010, 0.010], [0.050, 0.050]], atol=1e-12)
    # 40 mm in steps of half a tip's radius are 11 sites; there are at least 13.
    assert chart.side_count == 13
    assert make_chart(anatomy.face, 0.004).side_count == 21
    assert make_chart(anatomy.face, 0.001).side_count == 25
    np.testing.assert_allclose(chart.place([0.030, 0.050, 0.2]), [0.0, 1.0], atol=1e-12)


def test_a_chart_shared_by_a_process_cannot_be_written():
    """A site taken from its tables neither."""
    charted = charted_face(load_anatomy(make_scene("phantom_small")))
    touch_map, site = charted.touch_map, charted.site(np.array([5.0, 5.0]))
    assert site.moved > 0.0
    cached = (touch_map.sites, touch_map.places, touch_map.numbers, *touch_map.rows_and_columns, charted._surface)
    records = (charted.face, charted.chart, touch_map, site, HealthyMap(np.ones((2, 2, 3))))
    arrays = [part for record in records for part in vars(record).values() if isinstance(part, np.ndarray)]
    assert len(arrays) >= 16 and not any(array.flags.writeable for array in (*arrays, *cached))


@pytest.mark.parametrize("scene", ["phantom", "liver"])
def test_places_points_and_sites_are_each_others_inverse(scene: str):
    anatomy = load_anatomy(make_scene(scene))
    chart = make_chart(anatomy.face, anatomy.scene.instrument.tip_radius)
    assert chart.side_count % 2 == 1
    plane = chart.plane_point(chart.sites)
    points = plane[:, :1] * chart.across + plane[:, 1:] * chart.along
    np.testing.assert_allclose(chart.place(points), chart.sites, atol=1e-9)
    # Every place that a raster of the face allows is on the chart.
    allowed = chart.place(anatomy.face.raster(0.01)[0])
    assert np.abs(allowed).max() <= 1.0 + 1e-9


@pytest.mark.parametrize(("scene", "count"), [("phantom_small", 11 * 11), ("phantom", 13 * 13), ("liver", None)])
def test_the_touch_map_holds_the_sites_that_may_be_pressed(scene: str, count: int | None):
    charted = charted_face(load_anatomy(make_scene(scene)))
    chart, touch_map, face = charted.chart, charted.touch_map, charted.face
    assert charted.cell == pytest.approx(0.4 * charted.tip_radius)
    assert touch_map.pressable.shape == (MAP_SIDE**2,) and touch_map.pressable.sum() == (
        count or touch_map.pressable.sum()
    )
    assert touch_map.nearest(touch_map.places).tolist() == list(range(MAP_SIDE**2))
    middle = MAP_SIDE**2 // 2
    np.testing.assert_allclose(touch_map.places[middle], [0.0, 0.0], atol=1e-12)
    # What may be pressed is on the chart, is pressed where it lies, and is what the face says.
    allowed = touch_map.places[touch_map.pressable]
    assert np.abs(allowed).max() <= 1.0 + 1e-12
    assert max(charted.site(place).moved for place in allowed) == 0.0
    beyond = touch_map.places[~touch_map.pressable & (np.abs(touch_map.places) <= 1.0).all(axis=1)]
    on_face = [face.site(*chart.plane_point(place).tolist(), slack=1e-9) for place in beyond]
    assert all(charted.anatomy.is_covered(site[0]) for site in on_face if site is not None)
    # A place is nearest to the site of its cell, and those beyond the square have none.
    cell = 2.0 * charted.cell / chart.extent
    assert touch_map.nearest(0.49 * cell) == middle
    assert touch_map.nearest(0.51 * cell) == middle + MAP_SIDE + 1
    assert touch_map.nearest([(MAP_SIDE // 2 + 1) * cell[0], 0.0]) == -1


def test_a_face_too_long_for_the_map_has_larger_cells():
    anatomy = load_anatomy(make_scene("phantom"))
    fine = replace(anatomy.scene.instrument, tip_radius=0.001)
    small = ChartedFace(replace(anatomy, scene=replace(anatomy.scene, instrument=fine)), charted_face(anatomy).chart)
    assert small.cell == pytest.approx(0.040 / (MAP_SIDE - 1))
    assert small.touch_map.pressable.all()


def test_no_site_lies_under_a_ligament():
    """A press there feels what holds the organ: several times the stiffness of the tissue, whatever hides below."""
    anatomy = load_anatomy(make_scene("liver"))
    charted = charted_face(anatomy)
    (ligament,) = (anchor.ball for anchor in anatomy.scene.anchors if anchor.name == "falciform ligament, back")
    touch_map, chart, tip = charted.touch_map, charted.chart, charted.tip_radius
    on_face = [anatomy.face.site(*chart.plane_point(place).tolist()) for place in touch_map.places]
    held = anatomy.mesh.points[anatomy.foundation_nodes]
    covered = [
        number
        for number, site in enumerate(on_face)
        if site is not None and np.linalg.norm(held - site[0], axis=1).min() <= tip
    ]
    assert len(covered) > 10 and not touch_map.pressable[covered].any()
    assert any(np.linalg.norm(on_face[number][0] - ligament.centre) < ligament.radius for number in covered)
    sites = [*charted.grid_sites(), *(charted.site(touch_map.places[number]) for number in covered)]
    assert min(np.linalg.norm(held - site.point, axis=1).min() for site in sites) > tip
    assert min(site.moved for site in sites[-len(covered) :]) > 0.0


def test_the_healthy_map_beside_the_liver_is_of_its_organ():
    """If not, `write_healthy_map` (scenes/README.md) makes it anew."""
    anatomy = load_anatomy(with_instrument(make_scene("liver"), "probe"))
    assert _shipped(healthy_file(anatomy.scene.folder / "liver.toml"), map_digest(anatomy)) is not None
