"""Agents and how they are trained and scored; run from a checkout, not packaged: see agents/README.md."""
