"""A scripted expert for SurgSim/Palpate-v0 with memory=True: slide over the face, go back to the stiffest, declare.

It has no state: each action follows from one observation, so that a network can be taught to do the same
(`agents/dagger.py`). The tip slides along rows at a steady depth, less where the force nears the soft limit; what it
felt is in the observation. When the rows are done it feels around the stiffest place, goes there and declares it.

    python -m agents.expert_palpate --scene phantom --episodes 48
"""

import argparse

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import surgsim_env  # noqa: F401  (registers the ids)

SPEED = 0.02  # [m/s] full scale of the action
CONTROL_STEP = 0.05  # [s]


class PalpateExpert:
    """Actions (n, 4) for observations (n, n_observation) of a block's flat top."""

    def __init__(
        self,
        env: gym.Env,
        *,
        depth: float = 0.003,
        row_spacing: float = 0.010,
        refine_radius: float = 0.006,
        blur: float = 0.005,
        force_share: float = 0.75,
    ) -> None:
        """Read the chart, the block's height and the soft limit from an environment.

        Args:
            env: with memory=True.
            depth: that it slides at [m].
            row_spacing: at most so far apart are the rows [m].
            refine_radius: around the stiffest place, all sites are felt before it is declared [m].
            blur: the stiffest place is sought in the map blurred by a Gaussian of this width [m].
            force_share: it lifts where the force is above this share of the soft limit.
        """
        scene, task = env.unwrapped.scene, env.unwrapped.task
        if scene.mesh.block is None:
            raise ValueError(
                f"this expert slides on the flat top of a block; scene {scene.name!r} is none: use phantom"
            )
        if task.memory is None:
            raise ValueError("this expert has no memory of its own: make the environment with memory=True")
        self.chart = task.memory.chart
        self.radius, self.top = scene.instrument.tip_radius, scene.mesh.block.size[2]
        self.force_most = force_share * scene.limits.soft_force
        self.depth, self.refine_radius = depth, refine_radius
        self.places = self.chart.plane_point(self.chart.sites)
        side = self.chart.side_count
        self.way = self._way(side, row_spacing)
        gaps = np.linalg.norm(self.places[:, None] - self.places[None], axis=2)
        self.blur = np.exp(-0.5 * (gaps / blur) ** 2)
        self.gaps = gaps

    def act(self, observations: NDArray) -> NDArray[np.float32]:
        """The next actions."""
        return np.array([self._one(row) for row in np.asarray(observations, dtype=np.float64)], dtype=np.float32)

    def _way(self, side: int, row_spacing: float) -> NDArray[np.int64]:
        """Numbers of the sites along the rows, in alternating directions."""
        row_count = int(np.ceil(self.chart.extent[1] / row_spacing)) + 1
        rows = np.unique(np.round(np.linspace(0, side - 1, row_count)).astype(int))
        numbers = np.arange(side * side).reshape(side, side)
        return np.concatenate([numbers[row, :: 1 if index % 2 == 0 else -1] for index, row in enumerate(rows)])

    def _one(self, observation: NDArray[np.float64]) -> NDArray[np.float64]:
        tip, force = observation[:3], observation[8]
        count = len(self.places)
        contrast, visited = observation[10 : 10 + count], observation[10 + count : 10 + 2 * count] > 0.5
        target, declares = self._target(tip[:2], contrast, visited)
        gap = target - tip[:2]
        distance = float(np.linalg.norm(gap))
        depth = self.radius + self.top - tip[2]
        far = distance > 0.012
        wanted = -0.001 if far else self.depth
        rise = (depth - wanted) / CONTROL_STEP / SPEED
        # The nearer the force comes to the limit, the less deep; above it, up.
        rise = max(rise, 20.0 * (force - self.force_most))
        ready = depth > 0.75 * self.depth or force > 0.8 * self.force_most or (far and depth < 0.0005)
        across = gap / CONTROL_STEP / SPEED if ready else np.zeros(2)
        declare = float(declares and distance < 0.0025)
        return np.clip([*across, 0.5 * rise, declare], -1.0, 1.0)

    def _target(self, tip: NDArray, contrast: NDArray, visited: NDArray) -> tuple[NDArray, bool]:
        """Where to go in the plane [m] (2,), and whether it is what to declare."""
        left = self.way[~visited[self.way]]
        if len(left):
            return self.places[left[0]], False
        peak = self._peak(contrast, visited)
        near = np.linalg.norm(self.places - peak, axis=1) < self.refine_radius
        left = np.flatnonzero(near & ~visited)
        if len(left):
            return self.places[left[np.argmin(np.linalg.norm(self.places[left] - tip, axis=1))]], False
        return peak, True

    def _peak(self, contrast: NDArray, visited: NDArray) -> NDArray:
        """The centre of the excess contrast around the stiffest place [m] (2,)."""
        weight = self.blur * visited
        smooth = (weight @ contrast) / np.maximum(weight.sum(axis=1), 1e-9)
        best = int(np.argmax(np.where(visited, smooth, -np.inf)))
        excess = np.maximum(smooth - np.median(smooth[visited]), 0.0) * visited * (self.gaps[best] < 0.008)
        if excess.sum() <= 0.0:
            return self.places[best]
        return excess @ self.places / excess.sum()


def play(envs: gym.vector.VectorEnv, expert, episodes: int, seed: int) -> list[dict]:
    """Last infos of so many episodes, with their seconds and largest force [N]; every environment plays its share."""
    observation, _ = envs.reset(seed=list(range(seed, seed + envs.num_envs)))
    records: list[list[dict]] = [[] for _ in range(envs.num_envs)]
    share = -(-episodes // envs.num_envs)
    steps, peak, total = np.zeros((3, envs.num_envs))
    while any(len(one) < share for one in records):
        observation, reward, terminated, truncated, info = envs.step(expert.act(observation))
        over = terminated | truncated
        steps += 1
        total += reward
        force = (
            np.where(over, info["final_info"]["force_peak"], info["force_peak"]) if over.any() else info["force_peak"]
        )
        peak = np.maximum(peak, force)
        for index in np.flatnonzero(over):
            final = {name: values[index] for name, values in info["final_info"].items() if not name.startswith("_")}
            records[index].append({**final, "steps": steps[index], "peak": peak[index], "return": total[index]})
            steps[index] = peak[index] = total[index] = 0.0
    return [record for one in records for record in one[:share]]


def main() -> None:
    """Print one line an episode, and the figures of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="phantom")
    parser.add_argument("--level", default=None)
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--seed", type=int, default=700_000)
    arguments = parser.parse_args()
    level = {} if arguments.level is None else {"level": arguments.level}
    envs = gym.make_vec(
        "SurgSim/Palpate-v0",
        num_envs=16,
        vectorization_mode="vector_entry_point",
        autoreset_mode="SameStep",
        dtype="float32",
        threads=1,
        scene=arguments.scene,
        memory=True,
        **level,
    )
    soft = envs.envs[0].unwrapped.scene.limits.soft_force
    records = play(envs, PalpateExpert(envs.envs[0]), arguments.episodes, arguments.seed)
    for record in records:
        print(
            f"success {record['success']!s:5} declared {record['declared']!s:5} error {record['error_mm']:5.1f} mm "
            f"{record['steps'] * 0.05:5.1f} s, peak {record['peak']:.2f} N, return {record['return']:6.2f} "
            f"{record['sim_fault']}"
        )
    found, seconds = [float(one["success"]) for one in records], [one["steps"] * 0.05 for one in records]
    gentle = [one["peak"] <= soft for one in records]
    print(
        f"{len(records)} episodes: success {np.mean(found):.0%}, median {np.median(seconds):.1f} s, "
        f"under the soft limit {np.mean(gentle):.0%}"
    )


if __name__ == "__main__":
    main()
