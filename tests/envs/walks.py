"""Random walks that touch the organ, for each environment: what contract tests step with."""

import numpy as np


def walk(env, rng):
    """Actions without end: random ones that also lead to the organ, so that contact and friction are in play."""
    while True:
        action = rng.uniform(-0.5, 0.5, env.action_space.shape)
        if "Retract" in env.spec.id:
            action[1] = 0.4 * action[1] - 0.8  # towards the free edge
            # The jaw nearly closed, so that it does not pass above and below the lobe.
            action[env.unwrapped.layout.action_slices["jaw"].start] -= 0.5
        elif "TracePath" in env.spec.id:
            action *= (0.2, 0.2, 1.0)  # near the line
            action[2] -= 0.2
        elif "Slide" in env.spec.id:
            action[2] = abs(action[2])  # press
        elif "Sites" not in env.spec.id:
            approach = env.unwrapped.scene.instrument.approach
            action[:3] += 0.3 * np.array(approach) / np.linalg.norm(approach)  # press
        yield action.astype(np.float32)


def rollout(env, seed, steps, action_seed=7):
    """Observations, rewards, ends and infos of a walk from a seed."""
    actions = walk(env, np.random.default_rng(action_seed))
    records = [env.reset(seed=seed)]
    for _ in range(steps):
        records.append(env.step(next(actions)))
        if records[-1][2] or records[-1][3]:
            break
    return records
