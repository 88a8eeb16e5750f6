"""The environments: one class an id, with its documentation, its arguments and its task; `register` names them."""

from typing import Any

import gymnasium as gym

from surgsim_env.anatomy import load_anatomy
from surgsim_env.scenes import make_scene, with_instrument
from surgsim_env.surgical_env import SurgicalEnv
from surgsim_env.tasks.palpate import EPISODE_STEPS, PalpateTask


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

    ## Rewards
    Named terms, weighted in `surgsim_env.rewards.PALPATE_WEIGHTS`; `info["reward_<term>"]` shows each. Ending without
    finding (a wrong declare, the hard limit, a fault) also pays the dearest step for every step left, so that it never
    pays more than searching on.

    ## Starting State
    Radius, cover and modulus ratio of the lesion, its place on the palpable face, the sensor's bias and the tip's place
    2 to 6 mm above the surface are drawn anew; their ranges are in the scene file. The organ is at rest.

    ## Episode End
    Terminated: the lesion was declared (success within 10 mm of its centre, measured along the surface); the contact
    force passed the hard limit in any haptic step; the simulation came to a fault (`info["sim_fault"]` says which, the
    observation is the last finite one). Truncated: 600 control steps (30 s).

    ## Info
    Fixed keys and types: `sim_fault` (str, "" if none), `sensor_saturated`, `workspace_limited` (the box, or an arm's
    joint and speed limits), `hard_limit`, `declared`, `success` (bool), `force_peak` [N], `error_mm` (-1 if nothing was
    declared), `trocar_error_mm` (distance of the shaft's axis from the trocar; -1 for the probe, which passes through
    none), `added_mass` [kg] (of the scene's mass scaling, 0 without), one `reward_<term>` each.

    ## Arguments
    * `scene`: a scene's name (`surgsim_env.list_scenes()`) or the path of a scene file; default "phantom".
    * `instrument`: "probe", the name of an arm (`surgsim_env.list_arms()`, such as "psm_palpator") or the path of an
      arm's TOML file (docs/arms.md); by default the scene's own. An arm enters the body at the scene's `[port]`, and
      its tip points along the scene's approach as far as its joints allow.
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
        self, scene: str = "phantom", instrument: str | None = None, render_mode: str | None = None, **pictures: Any
    ) -> None:
        anatomy = load_anatomy(with_instrument(make_scene(scene), instrument))
        super().__init__(anatomy, PalpateTask(anatomy), render_mode=render_mode, pictures=pictures)


def register() -> None:
    """Register the environment ids with Gymnasium; importing `surgsim_env` does it."""
    if "SurgSim/Palpate-v0" not in gym.registry:
        gym.register(
            id="SurgSim/Palpate-v0",
            entry_point="surgsim_env.env:PalpateEnv",
            vector_entry_point="surgsim_env.vector_env:PalpateVectorEnv",
            max_episode_steps=EPISODE_STEPS,
        )
