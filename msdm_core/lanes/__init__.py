"""Vectorised organs, side by side in vector registers."""

from msdm_core.lanes.lanes import lane_responses, lanes_of, stack_organs, stack_shapes

__all__ = [
    "lane_responses",
    "lanes_of",
    "stack_organs",
    "stack_shapes",
]
