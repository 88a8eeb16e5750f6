"""Levels: what they draw keeps their ranges, fits, weighs little, and survives being written down."""

import math
from dataclasses import replace

import numpy as np
import pytest

from surgsim_env.scene import levels
from surgsim_env.scene.anatomy import load_anatomy
from surgsim_env.scene.levels import LEVELS, DrawnOrgan, Level
from surgsim_env.scene.load import make_scene

SCENES = ("phantom", "phantom_small")


def shares(bounds: tuple[float, float], share: tuple[float, float]) -> tuple[float, float]:
    low, high = bounds
    return low + share[0] * (high - low), low + share[1] * (high - low)


@pytest.mark.parametrize("level", LEVELS.values(), ids=LEVELS)
@pytest.mark.parametrize("name", SCENES)
def test_draws_keep_their_ranges_and_their_distance(name: str, level: Level):
    scene = make_scene(name)
    anatomy = load_anatomy(level.scene(scene))
    for seed in range(60):
        drawn = level.draw(anatomy, np.random.default_rng(seed))
        low, high = level.background
        assert low <= drawn.background <= high
        for index, lesion in enumerate(drawn.lesions):
            radius = shares(scene.lesion.radius, level.radius)
            cover = shares(scene.lesion.cover, level.cover)
            ratio = lesion.material.youngs_modulus / (scene.material.youngs_modulus * drawn.background)
            assert radius[0] <= lesion.radius <= radius[1]
            # The cover is met to 0.1 mm.
            assert cover[0] - 1e-4 <= anatomy._free_surface.distances(np.array(lesion.centre)[None])[0] - lesion.radius
            assert anatomy._free_surface.distances(np.array(lesion.centre)[None])[0] - lesion.radius <= cover[1] + 1e-4
            least, most = shares(scene.lesion.modulus_ratio, level.modulus_ratio)
            assert least * (1 - 1e-12) <= ratio <= most * (1 + 1e-12)
            for other in drawn.lesions[:index]:
                assert math.dist(lesion.centre, other.centre) >= lesion.radius + other.radius + 0.006


def test_numbers_of_lesions_capsules_and_moduli_come_as_often_as_the_level_says():
    level = LEVELS["standard"]
    anatomy = load_anatomy(level.scene(make_scene("phantom")))
    # So that the draw is quick: lesions of hardly any size fit anywhere.
    tiny = replace(anatomy.scene.lesion, radius=(1e-3, 1e-3), cover=(1e-3, 1e-3), rim_distance=0.02)
    anatomy = replace(anatomy, scene=replace(anatomy.scene, lesion=tiny))
    count = 400
    drawn = [level.draw(anatomy, np.random.default_rng(seed)) for seed in range(count)]
    numbers = np.bincount([len(sample.lesions) for sample in drawn], minlength=4)
    for number, weight in zip(numbers, level.lesion_count_weights, strict=True):
        # Four standard deviations of a binomial share.
        assert abs(number - count * weight) <= 4.0 * math.sqrt(count * weight * (1.0 - weight))
    capsules = [sample.capsule_stiffness for sample in drawn if sample.capsule_stiffness > 0.0]
    assert abs(len(capsules) - 0.5 * count) <= 4.0 * math.sqrt(0.25 * count)
    assert 5.0 <= min(capsules) < 6.0 and 19.0 < max(capsules) <= 20.0
    # A uniform number of width w has the standard deviation w / sqrt(12).
    background = np.array([sample.background for sample in drawn])
    assert abs(background.mean() - 1.0) < 4.0 * 0.6 / math.sqrt(12.0 * count)
    assert background.std() == pytest.approx(0.6 / math.sqrt(12.0), rel=0.1)


def test_a_draw_survives_json_to_the_bit_and_differs_from_the_scenes_organ():
    level = LEVELS["standard"]
    anatomy = load_anatomy(level.scene(make_scene("phantom_small")))
    drawn = next(
        sample
        for sample in (level.draw(anatomy, np.random.default_rng(seed)) for seed in range(40))
        if sample.capsule_stiffness > 0.0 and len(sample.lesions) == 2
    )
    again = DrawnOrgan.from_json(drawn.to_json(), anatomy)
    assert again == drawn
    organ, other = drawn.compiled(anatomy), again.compiled(anatomy)
    for name in organ._fields:
        np.testing.assert_array_equal(getattr(organ, name), getattr(other, name))
    # Far from lesions and surface a spring is that of the scene times the background's factor.
    plain = anatomy.organ()
    ratio = organ.spring_stiffness / plain.spring_stiffness
    assert ratio.min() == pytest.approx(drawn.background, rel=1e-12)
    without = replace(drawn, capsule_stiffness=0.0).compiled(anatomy)
    assert (organ.spring_stiffness > without.spring_stiffness * (1.0 + 1e-12)).any()


def test_a_level_changes_sensor_and_mass_scaling_alone():
    scene = make_scene("phantom")
    hard = LEVELS["hard"].scene(scene)
    assert (hard.sensor.noise, hard.sensor.bias) == (3.0 * scene.sensor.noise, 2.0 * scene.sensor.bias)
    assert hard.timing.mass_scaling and not scene.timing.mass_scaling
    assert replace(hard, sensor=scene.sensor, timing=scene.timing) == scene


def test_stiff_draws_get_little_mass_and_need_no_more_substeps():
    level = LEVELS["standard"]
    anatomy = load_anatomy(level.scene(make_scene("phantom_small")))
    stiff = replace(level, background=(1.6, 1.6), radius=(1.0, 1.0), cover=(0.0, 0.0), modulus_ratio=(1.0, 1.0))
    organ = stiff.draw(anatomy, np.random.default_rng(1), lesion_count=2).compiled(anatomy)
    assert 0.0 < organ.added_mass < 0.1 * organ.node_mass.sum()


def test_scenes_that_a_level_cannot_draw_from_are_refused(monkeypatch):
    with pytest.raises(ValueError, match="'lobe'"):
        LEVELS["easy"].scene(make_scene("lobe"))
    scene = make_scene("phantom")
    wide = replace(scene, lesion=replace(scene.lesion, radius=(0.002, 0.012)))
    LEVELS["standard"].scene(wide)
    with pytest.raises(ValueError, match=r"'hard'.*lesion\.radius"):
        LEVELS["hard"].scene(wide)
    monkeypatch.setattr(levels, "TRIES_MOST", 3)
    crowded = load_anatomy(LEVELS["standard"].scene(make_scene("phantom_small")))
    with pytest.raises(ValueError, match="9 lesions"):
        LEVELS["standard"].draw(crowded, np.random.default_rng(0), lesion_count=9)
