"""Robot arms that carry an instrument through a trocar: described in TOML, moved by inverse kinematics."""
