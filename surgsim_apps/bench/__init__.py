"""`surgsim bench`: what a substep, a haptic step, a control step and a start cost here, beside other simulators."""
