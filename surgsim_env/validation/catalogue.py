"""Every case, in the order of the table."""

from functools import partial

from surgsim_env.validation import beams, lattice, lumped_mass, prism, sphere, steps
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
    Case("Eshelby, coarse", partial(sphere.eshelby, (3.0,), 0.25, 16)),
    Case("Eshelby, nu 0.25", partial(sphere.eshelby, (3.0, 5.0, 8.0), 0.25), slow=True),
    Case("Eshelby, nu 0.45", partial(sphere.eshelby, (5.0,), 0.45), slow=True),
)
