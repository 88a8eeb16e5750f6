"""Vectorised organs, side by side in vector registers."""

from msdm_core.lanes.lanes import lane_responses, stack_organs, stack_shapes, stack_states

__all__ = [
    "lane_responses",
    "stack_organs",
    "stack_shapes",
    "stack_states",
]
