"""The summary of an evaluation as plain JSON types, for summary.json."""

import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.arm_study.candidates import APPROACH_ANGLE, DIRECTION_COUNT, REACHED
from surgsim_env.arm_study.collisions import MEETING_ZONE, TIP_ZONE
from surgsim_env.arm_study.dexterity import CHARACTERISTIC_LENGTH
from surgsim_env.arm_study.ports import InnerTarget, Ports
from surgsim_env.arm_study.reach import ARM_DISTANCE, BothArms, Sites
from surgsim_env.arm_study.results import QUANTITIES, REASONS, ArmReach, spread


def summarise(
    sites: Sites,
    left: ArmReach,
    right: ArmReach,
    both: BothArms,
    targets: Sequence[InnerTarget],
    inputs: Mapping[str, Any],
    seed: int,
) -> dict[str, Any]:
    """Shares, extremes, targets, versions, seed and inputs; SI units; the same run gives the same text."""
    outer = ~sites.inner
    return {
        "points": int(outer.sum()),
        "reachable": {
            "left": _share(left.reachable[outer]),
            "right": _share(right.reachable[outer]),
            "either": _share((left.reachable | right.reachable)[outer]),
            "both": _share(both.reachable[outer]),
        },
        "left": _arm(left, outer),
        "right": _arm(right, outer),
        "arm_distance_inside": _extremes(both.inside[outer]),
        "arm_distance_outside": _extremes(both.outside[outer]),
        "targets": _targets(sites, left, right, both, targets),
        "rules": {
            "reached_within": REACHED,
            "approach_directions": DIRECTION_COUNT,
            "approach_angle": APPROACH_ANGLE,
            "characteristic_length": CHARACTERISTIC_LENGTH,
            "tip_zone": TIP_ZONE,
            "meeting_zone": MEETING_ZONE,
            "arm_distance": ARM_DISTANCE,
        },
        "versions": _versions(),
        "seed": seed,
        "inputs": dict(inputs),
    }


def plain_ports(ports: Ports) -> dict[str, Any]:
    """Ports as plain JSON types."""
    return _plain(asdict(ports))


def _arm(arm: ArmReach, outer: np.ndarray) -> dict[str, Any]:
    counts = {reason: int((arm.reason[outer] == index).sum()) for index, reason in enumerate(REASONS)}
    return {
        "arm": arm.name,
        "reasons": counts,
        **{one.field: _extremes(getattr(arm, one.field)[outer]) for one in QUANTITIES if one.field != "position_error"},
    }


def _targets(
    sites: Sites, left: ArmReach, right: ArmReach, both: BothArms, targets: Sequence[InnerTarget]
) -> list[dict[str, Any]]:
    rows = np.flatnonzero(sites.inner)
    return [
        {
            "name": target.name,
            "point": list(target.point),
            "left": REASONS[left.reason[row]],
            "right": REASONS[right.reason[row]],
            "both": bool(both.reachable[row]),
        }
        for row, target in zip(rows, targets, strict=True)
    ]


def _extremes(values: FloatArray) -> dict[str, float | None]:
    """Least, median and greatest of the finite values; None where there are none."""
    return {name: None if math.isnan(value) else value for name, value in spread(values)._asdict().items()}


def _share(flags: np.ndarray) -> float | None:
    return float(flags.mean()) if flags.size else None


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in ("surgsim", "numpy", "scipy", "mujoco"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return value
