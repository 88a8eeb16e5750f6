"""Palpation: presses, charts of faces, contrast maps, lesion estimators, errors."""

from surgsim_env.palpation.chart import MAP_SIDE, TouchMap, healthy_file, interpolated, write_healthy_map
from surgsim_env.palpation.lesion_estimator import (
    BACKGROUND_SPREAD,
    EXCESS_SPREAD,
    LESIONS_MOST,
    ORGAN_MAP_SPREAD,
    LesionEstimate,
    LesionEstimator,
    contrast_process,
    strongest_apart,
)
from surgsim_env.palpation.member_chart import member_map, still_template
from surgsim_env.palpation.scores import (
    CUTOFF,
    FOUND_SHARE,
    map_errors,
    map_score,
    matched_distances,
    ospa,
    ospa_cutoff,
)
from surgsim_env.palpation.site_press import (
    HOLD_TIME,
    PRESS_SPEED,
    Press,
    SitePress,
    press,
    press_alone,
    press_phases,
    scan,
)
from surgsim_env.palpation.touches import Indenter

__all__ = [
    "BACKGROUND_SPREAD",
    "CUTOFF",
    "EXCESS_SPREAD",
    "FOUND_SHARE",
    "HOLD_TIME",
    "LESIONS_MOST",
    "MAP_SIDE",
    "ORGAN_MAP_SPREAD",
    "PRESS_SPEED",
    "Indenter",
    "LesionEstimate",
    "LesionEstimator",
    "Press",
    "SitePress",
    "TouchMap",
    "contrast_process",
    "healthy_file",
    "interpolated",
    "map_errors",
    "map_score",
    "matched_distances",
    "member_map",
    "ospa",
    "ospa_cutoff",
    "press",
    "press_alone",
    "press_phases",
    "scan",
    "still_template",
    "strongest_apart",
    "write_healthy_map",
]
