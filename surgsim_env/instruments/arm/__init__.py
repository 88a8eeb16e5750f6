"""Robot arms: one arm, two arms, inverse kinematics, placement at ports."""
