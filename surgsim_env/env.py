"""The environments: one class an id, with its documentation, its arguments and its task."""

from typing import Any

from surgsim_env.anatomy import load_anatomy
from surgsim_env.levels import find_level
from surgsim_env.retract_scene import make_retract_scene
from surgsim_env.scenes import make_scene, with_instrument
from surgsim_env.simulation import Simulation
from surgsim_env.surgical_env import SurgicalEnv
from surgsim_env.tasks.bimanual_retract import BimanualRetractTask
from surgsim_env.tasks.palpate import PalpateTask
from surgsim_env.tasks.retract import RetractTask


class PalpateEnv(SurgicalEnv):
    """Find a hidden lesion by touch.

    ## Description
    A robot's ball tip presses a soft organ (a tetrahedral mass-spring-damper model, Sala et al. 2011) with one stiff
    lesion hidden under its surface. Tissue and tip exchange forces 1000 times a second; the agent acts 20 times a
    second. It wins by pressing on the lesion and declaring it.

    ## Action Space
    `Box(-1, 1, (4,), float32)`

    | num | meaning | full scale |
    |---|---|---|
    | 0-2 | tip velocity along x, y, z | 20 mm/s |
    | 3 | declare: above 0.8 for 3 successive control steps, in contact, says "the lesion is here" | |

    ## Observation Space
    `Box((10,), float32)`, all bounds finite

    | num | meaning | bounds |
    |---|---|---|
    | 0-2 | tip position [m] | the organ's bounding box with a margin |
    | 3-5 | tip velocity [m/s] | +-0.5 |
    | 6-8 | contact force on the tip [N], mean of the last haptic step, through the sensor model | +-range |
    | 9 | share of the time left | 0 to 1 |

    With `memory=True`, for a grid of n sites on the palpable face (`surgsim_env.palpation.chart`), what the sensor felt
    there so far (`surgsim_env.palpation.touch_memory`), `Box((13 + 2 n,), float32)`; n is 169 on `phantom`:

    | num | meaning | bounds |
    |---|---|---|
    | 10 to 9 + n | contrast: force over healthy tissue's at that depth; 0 where nothing was felt | +-bound |
    | 10 + n to 9 + 2 n | 1 where something was felt | 0 to 1 |
    | last 3 | where it was stiffest, on the face's chart, and its contrast there | +-1, +-bound |

    ## Rewards
    Named terms, weighted in `surgsim_env.rewards.PALPATE_WEIGHTS`; `info["reward_<term>"]` shows each. Ending without
    finding (a wrong declare, the hard limit, a fault) also pays the dearest step for every step left, so that it never
    pays more than searching on.

    ## Starting State
    Radius, cover and modulus ratio of the lesion, its place on the palpable face, the sensor's bias and the tip's place
    2 to 6 mm above the surface are drawn anew; their ranges are in the scene file. The organ is at rest. With a `level`
    its modulus and a capsule are drawn too, lesions and sensor are as the level has them (`surgsim_env.levels`).

    ## Episode End
    Terminated: the lesion was declared (success within 10 mm of its centre, measured along the surface); the contact
    force passed the hard limit in any haptic step; the simulation came to a fault (`info["sim_fault"]` says which, the
    observation is the last finite one). Truncated: 600 control steps (30 s).

    ## Info
    Fixed keys and types: `sim_fault` (str, "" if none), `sensor_saturated`, `workspace_limited` (the box, or an arm's
    joint and speed limits), `hard_limit`, `declared`, `success` (bool), `force_peak` [N], `cost` (force over the soft
    limit, 1 at the hard one: a constraint for safe learning), `error_mm` (-1 if nothing was declared),
    `trocar_error_mm` (distance of the shaft's axis from the trocar; -1 for the probe, which passes through none),
    `added_mass` [kg] (of mass scaling, 0 without), one `reward_<term>` each.

    ## Arguments
    * `scene`: a scene's name (`surgsim_env.list_scenes()`) or the path of a scene file; default "phantom".
    * `instrument`: "probe", the name of an arm (`surgsim_env.list_arms()`, such as "psm_palpator") or the path of an
      arm's TOML file (docs/arms.md); by default the scene's own. An arm enters the body at the scene's `[port]`, and
      its tip points along the scene's approach as far as its joints allow.
    * `level`: "easy", "standard" or "hard" (`surgsim_env.levels`); None, the default: the scene's ranges as they are.
    * `memory`: whether the observation holds what was felt so far; without it the agent must remember by itself.
    * `render_mode`: None, "rgb_array" (off screen, no display needed) or "human" (a window).
    * `camera`, `width`, `height`, `show_force`, `show_lesion`, `cut_away` and the other fields of
      `surgsim_env.rendering.options.RenderOptions`: what pictures show. `env.unwrapped.renderer` also draws depth and
      the label of each pixel.

    `env.unwrapped.save_state()` and `load_state()` cover organ, robot, task, counters and random generator; wrappers'
    own counts (TimeLimit) they cannot reach: load a state into an environment that was just reset.

    ## Version History
    * v0: first version.
    """

    task: PalpateTask

    def __init__(
        self,
        scene: str = "phantom",
        instrument: str | None = None,
        level: str | None = None,
        render_mode: str | None = None,
        memory: bool = False,
        **pictures: Any,
    ) -> None:
        chosen = None if level is None else find_level(level)
        described = with_instrument(make_scene(scene), instrument)
        anatomy = load_anatomy(described if chosen is None else chosen.scene(described))
        task = PalpateTask(anatomy, chosen, memory=memory)
        super().__init__(Simulation(anatomy), task, render_mode=render_mode, pictures=pictures)


class RetractEnv(SurgicalEnv):
    """Grasp a lobe and fold it back until the endoscope sees what it hides.

    ## Description
    A lobe of soft tissue, held along one edge, lies on its bed and hides a disc. A robot's jaw grasps it near its free
    edge, with friction alone, and lifts or folds it until the endoscope sees at least 80 % of the disc for half a
    second. Tissue and jaw exchange forces 1000 times a second; the agent acts 20 times a second.

    ## Action Space
    `Box(-1, 1, (4 + n,), float32)`; n numbers turn the wrist: 0 for an instrument that does not turn, 1 or 3.

    | num | meaning | full scale |
    |---|---|---|
    | 0-2 | tip velocity along x, y, z | 20 mm/s |
    | 3 to 2 + n | how the tip turns | 0.5 rad/s |
    | last | where the jaw goes, at its limited speed: -1 closed, 1 open | |

    ## Observation Space
    `Box((50,), float32)`, all bounds finite; 6 more (in brackets) for an instrument that turns

    | num | meaning | bounds |
    |---|---|---|
    | 0-2 | tip position [m] | the lobe's bounding box with a margin |
    | 3-5 | tip velocity [m/s] | +-0.5 |
    | (6-11) | the tip's x and z axes in the world | +-1 |
    | 6 | gap between the pads [m] | +-0.1 |
    | 7-9 | contact force on the jaw [N], mean of the last haptic step, through the sensor model | +-range |
    | 10-12 | its torque about the tip [N m], likewise | +-range x 10 mm |
    | 13 | grip force: the smaller of the two pads' normal forces [N] | 0 to 200 |
    | 14 | pull force: the size of the sum of both fingers' forces [N] | 0 to 200 |
    | 15 | 1 where both pads press tissue | 0 to 1 |
    | 16-30 | five points of the free edge, on top, along x [m] | the lobe's box and 0.1 m |
    | 31-45 | five points half way to the held edge, likewise [m] | the lobe's box and 0.1 m |
    | 46 | share of the target that the endoscope sees | 0 to 1 |
    | 47-48 | the target's place: x, y [m] | the scene's ranges |
    | 49 | share of the time left | 0 to 1 |

    With `obs_mode="rgb"` it is the endoscope's picture instead: `Box(0, 255, (84, 84, 3), uint8)`.

    ## Rewards
    Named terms, weighted in `surgsim_env.rewards.RETRACT_WEIGHTS`; `info["reward_<term>"]` shows each. What is seen and
    what is grasped pay by their changes, so that neither can be farmed. An episode that ends in harm pays less than any
    that runs its time.

    ## Starting State
    The lobe's size and stiffness, its capsule, how much of its edge is held, the target's place, where the endoscope
    stands and looks, the sensors' biases and the tip's place are drawn anew; their ranges are in the scene file. The
    lobe rests settled on its bed, the jaw is open, and at most 10 % of the target is seen: other draws are made again.

    ## Episode End
    Terminated: 80 % of the target were seen for 0.5 s (success); the contact force passed the hard limit, or the jaw's
    pull what the tissue bears, in any haptic step; the simulation came to a fault (`info["sim_fault"]` says which, the
    observation is the last finite one). Truncated: 600 control steps (30 s).

    ## Info
    Fixed keys and types. Of the step: `sim_fault` (str, "" if none), `sensor_saturated`, `workspace_limited`,
    `hard_limit`, `torn`, `success`, `holds` (bool), `visible` (share), `grip_force`, `pull_force`, `friction_left`
    (what friction could still hold) and `force_peak` [N], `trocar_error_mm`, `added_mass` [kg], one `reward_<term>`
    each. Of the episode so far: `grip_force_peak`, `grip_force_mean`, `pull_force_peak`, `pull_force_mean` [N] (means
    over the steps that held something), `pull_impulse` [N s], `slips` (holds that began to slip, or were lost with the
    jaw told to be closed), `path_length` of the tip [m], `strain_held`, `strain_middle`, `strain_free`: largest strain
    of an edge of the mesh in the lobe's thirds, from the held edge to the free one.

    ## Arguments
    * `scene`: a scene's name or the path of a scene file with a `[retract]` table, or that names such a file, as
      those of `surgsim organ` do; default "lobe".
    * `instrument`: the scene's own by default, or the name of an arm with a jaw, or the path of its TOML file.
    * `obs_mode`: "state" (default) or "rgb" (needs OpenGL).
    * `render_mode`: None, "rgb_array" (off screen, no display needed) or "human" (a window).
    * `camera`, `width`, `height` and the other fields of `surgsim_env.rendering.options.RenderOptions`.

    ## Version History
    * v0: first version.
    """

    task: RetractTask

    def __init__(
        self,
        scene: str = "lobe",
        instrument: str | None = None,
        obs_mode: str = "state",
        render_mode: str | None = None,
        **pictures: Any,
    ) -> None:
        anatomy = load_anatomy(with_instrument(make_retract_scene(scene), instrument))
        simulation = Simulation(anatomy)
        task = RetractTask(anatomy, simulation.instrument)
        super().__init__(simulation, task, render_mode=render_mode, pictures=pictures, obs_mode=obs_mode)


class BimanualRetractEnv(SurgicalEnv):
    """Lift a lobe with one arm and touch with the other what lay under it.

    ## Description
    The lobe of `SurgSim/Retract-v0` hides a disc on its bed. The left of two robot arms grasps the lobe and folds it
    back; the right one reaches under it and touches the disc gently for half a second. Tissue, bed and arms press each
    other 1000 times a second; one agent commands both arms 20 times a second. `surgsim_env.bimanual_parallel` is the
    same for two agents.

    ## Action Space
    `Box(-1, 1, (13,), float32)`

    | num | meaning | full scale |
    |---|---|---|
    | 0-2 | left tip's velocity along x, y, z | 20 mm/s |
    | 3-5 | how the left tip turns | 0.5 rad/s |
    | 6 | where the left jaw goes, at its limited speed: -1 closed, 1 open | |
    | 7-9 | right tip's velocity | 20 mm/s |
    | 10-12 | how the right tip turns | 0.5 rad/s |

    ## Observation Space
    `Box((74,), float32)`, all bounds finite: the 56 numbers of `SurgSim/Retract-v0` with an arm, the left one's, then

    | num | meaning | bounds |
    |---|---|---|
    | 56-58 | right tip's position: the centre of its ball [m] | the lobe's bounding box with a margin |
    | 59-61 | right tip's velocity [m/s] | +-0.5 |
    | 62-67 | the right tip's x and z axes in the world | +-1 |
    | 68-70 | tissue's force on the right arm [N], through the sensor model | +-range |
    | 71 | force between the right arm and the bed [N] | 0 to 200 |
    | 72 | share of the target that the organ leaves uncovered, seen from the endoscope | 0 to 1 |
    | 73 | distance of the arms, at most 0.05 [m] | +-0.1 |

    ## Rewards
    Named terms, weighted in `surgsim_env.rewards.BIMANUAL_WEIGHTS`; `info["reward_<term>"]` shows each. What is reached
    pays by its changes. An episode that ends in harm pays less than any that runs its time.

    ## Starting State
    That of `SurgSim/Retract-v0`, and the right tip somewhere on the free side.

    ## Episode End
    Terminated: for 0.5 s, at the end of each control step, the left jaw held tissue, the organ left at least 80 % of
    the target uncovered as seen from the endoscope (instruments do not count), and the right ball, its centre above the
    disc, pressed what lies under it with 0.3 to 1.0 N (success); the contact force on the tissue passed the hard limit,
    or the jaw's pull what the tissue bears, in any haptic step; at the end of a control step, the right arm pressed the
    bed with more than the hard limit or the left arm with more than 2 N; the simulation came to a fault. Truncated: 600
    control steps (30 s).

    ## Info
    That of `SurgSim/Retract-v0`, and `collided`, `touches` (bool), `uncovered` (share), `touch_force`,
    `collision_force` [N].

    ## Arguments
    Those of `SurgSim/Retract-v0`; `instrument` is "psm_pair", or two arms (names or TOML files) as "LEFT+RIGHT":
    the left one has a jaw with flat pads, the right one a ball at its tip, as "psm_retractor+six_axis".

    ## Version History
    * v0: first version.
    """

    task: BimanualRetractTask

    def __init__(
        self,
        scene: str = "lobe",
        instrument: str = "psm_pair",
        obs_mode: str = "state",
        render_mode: str | None = None,
        **pictures: Any,
    ) -> None:
        anatomy = load_anatomy(with_instrument(make_retract_scene(scene), instrument))
        simulation = Simulation(anatomy)
        task = BimanualRetractTask(anatomy, simulation.instrument)
        super().__init__(simulation, task, render_mode=render_mode, pictures=pictures, obs_mode=obs_mode)
