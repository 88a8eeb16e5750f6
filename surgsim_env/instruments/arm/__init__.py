"""Robot arms, alone or in pairs: models, ports, inverse kinematics, control."""
