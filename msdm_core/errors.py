"""The errors of the organ model: each says what is wrong, which element, the value, the rule and the way out."""

__all__ = ["MeshError", "OrganDivergedError", "OrganError"]


class MeshError(ValueError):
    """A surface or tetrahedral mesh that cannot become an organ."""


class OrganError(ValueError):
    """An organ specification (materials, lesions, anchors, step) that breaks a physical rule."""


class OrganDivergedError(RuntimeError):
    """An organ whose state stopped being physical: an inverted tet or a number that is not finite."""
