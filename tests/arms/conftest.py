"""Fewer heat maps, for tests that look at what lies around them: each takes half a second of a processor."""

import pytest

from surgsim_apps.arms import pictures


@pytest.fixture
def few_maps(monkeypatch):
    """Who reaches what, one quantity and the distances between the arms, instead of all quantities."""
    shown = tuple(quantity for quantity in pictures.QUANTITIES if quantity.field == "tip_force")
    monkeypatch.setattr(pictures, "QUANTITIES", shown)
