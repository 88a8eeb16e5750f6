"""Every case, in the order of the table."""

from functools import partial

from surgsim_env.validation import (
    ball,
    beams,
    cosine,
    lattice,
    lumped_mass,
    paper_tests,
    passivity,
    prism,
    punch,
    sphere,
    steps,
)
from surgsim_env.validation.row import Case

CASES: tuple[Case, ...] = (
    Case("Table I", lumped_mass.table_one),
    Case("mass sum", lumped_mass.mass_sum),
    Case("BCC constants", lattice.constants),
    Case("thick block 8^3", partial(lattice.thick_block, 8)),
    Case("thick block 12^3", partial(lattice.thick_block, 12), slow=True),
    Case("bar in tension", prism.tension),
    Case("clamped torsion", prism.torsion, needs_fem=True),
    Case("cantilever", beams.cantilever_case, needs_fem=True),
    Case("fixed-free rod", beams.rod_case),
    Case("damping rate", beams.damping_case),
    Case("stable step", steps.stable_step),
    Case("energy", steps.energy_drift),
    Case("passivity, bounces", partial(passivity.bounces, ((0.005, 0.0005),))),
    Case("passivity, more bounces", partial(passivity.bounces, passivity.OTHER_FALLS), slow=True),
    Case("passivity, presses", partial(passivity.presses, 100)),
    Case("passivity, many presses", partial(passivity.presses, 1000), slow=True),
    Case("Eshelby, coarse", partial(sphere.eshelby, (3.0,), 0.25, 16)),
    Case("Eshelby, nu 0.25", partial(sphere.eshelby, (3.0, 5.0, 8.0), 0.25), slow=True),
    Case("Eshelby, nu 0.45", partial(sphere.eshelby, (5.0,), 0.45), slow=True),
    Case("flat punch", partial(punch.hayes, (12, 18))),
    Case("flat punch, fine", partial(punch.hayes, (24,)), slow=True),
    Case("elements of reference", punch.reference_check, needs_fem=True),
    Case("contrast, coarse", partial(punch.contrast, 18, 0.25, punch.COARSE), needs_fem=True),
    Case("contrast, covers", partial(punch.contrast, 24, 0.25, punch.COVERS, "contrast"), slow=True, needs_fem=True),
    Case("contrast, sizes", partial(punch.contrast, 24, 0.25, punch.OTHERS), slow=True, needs_fem=True),
    Case("contrast, nu 0.45", partial(punch.contrast, 24, 0.45, punch.COVERS, "contrast"), slow=True, needs_fem=True),
    Case("ball", partial(ball.ball_on_layer, 12, (0.001, 0.002, 0.003, 0.004)), slow=True, needs_fem=True),
    Case("ball, fine", partial(ball.ball_on_layer, 18, (0.0015, 0.002, 0.003, 0.004)), slow=True, needs_fem=True),
    Case("test A", paper_tests.run_test_a),
    Case("test B", paper_tests.run_test_b),
    Case("cosine load", partial(cosine.cosine_load, (3, 6))),
)
