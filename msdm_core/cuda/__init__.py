"""Organs on a CUDA device; needs the `cuda` extra."""

from msdm_core.cuda.organs import DeviceOrgans

__all__ = [
    "DeviceOrgans",
]
