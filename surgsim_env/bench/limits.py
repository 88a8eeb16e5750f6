"""What peers give and do not give, each with where that was read."""

# From running the two that are measured (mujoco 4.0.0, newton 1.8.0), from the others' repositories and threads.
LIMITS = """### What each can give

| simulator | moduli per region | tool force in newtons | Gymnasium environment of a soft organ | source |
|---|---|---|---|---|
| surgsim | per tet: capsule, lesions, tags | wrench on each tool, every 1 ms | yes | this repository |
| MuJoCo flex | no: `young` is one number a flex (elements' stiffness is writable after compilation, \
undocumented) | yes: sum of `mj_contactForce`; none with passive contact | no | run here; XML reference, `elasticity` |
| Newton, explicit | per tet | `body_f` of a body without joints; contact at particles only, not on faces | no \
| run here |
| Newton, vbd | per tet | `contact_f` observable | no | run here; Newton #3052 on deformable contact force |
| Isaac Lab | one a body | no: 0 for rigid-deformable contact, closed as not planned | yes, \
no soft organ in its surgical tasks | IsaacLab #806, #4290 |
| sofa_env (LapGym) | one a body | no: sum of internal forces, scaled by 1e-9 | yes, one simulation a process | \
ScheiklP/sofa_env 85bf7e0 |
| PyBullet soft bodies | one a body | no: the normal force is always 1 | no | bullet3 #4406, #3326, #4333 |
| FF-SRL | one a mesh | no | no, two demonstrations | SanoScience/FF-SRL 1036742 |

Only the first four were run here; the others are read from their code and threads, and may have moved since."""
