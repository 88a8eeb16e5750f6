"""Training and scoring of agents; run from a checkout, not packaged: see agents/README.md."""
