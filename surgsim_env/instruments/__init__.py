"""Instruments as MuJoCo bodies: probe, grasper, jaws and supports, and the arms that carry them."""
