"""Learn SurgSim/Slide-v0 from recorded slides: a network that maps lesions and says where to slide next.

    ARGS='{"split": "train", "face": true}'
    python -m agents.record_demonstrations SurgSim/Slide-v0 --by surgsim_apps.training.slide_agents:SlideRandom \
        --env-arguments "$ARGS" --episodes 256 --keep-failures --dataset surgsim/slide/train-v0
    python -m agents.learn_slide surgsim/slide/train-v0 --check surgsim/slide/validation-v0 --out runs/slide.safetensors

The labels are the true maps of the last infos, and for the next place the oracle's: the nearest lesion that the tip has
not touched. `--without taxels` and `--without memory` are ablations.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray
from torch.nn import functional

import surgsim_env  # noqa: F401  (registers the ids)
from surgsim_apps.cli.main import exit_status
from surgsim_apps.reports.output_folder import output_folder
from surgsim_apps.training.slide_agents import LESION_RADIUS, REACHED, SlideMemory
from surgsim_apps.training.slide_network import FORCE, NORMAL, TAXELS, SlideNetwork, declared_lesions, rasterised
from surgsim_env.palpation import LESIONS_MOST, MAP_SIDE, TouchMap, map_errors, map_score, ospa_cutoff

BATCH, RATE = 24, 4e-3
# Spread of a lesion's spot among the labels [tip radii].
SPOT = 0.5
# Weights of the losses of places, areas and the next place.
WEIGHTS = (3.0, 1.0, 0.1)
# First control step of a training example; later ones are drawn uniformly.
STEPS_LEAST = 20
# Moments of the episode of which a check is the mean.
MOMENTS = (0.15, 0.3, 0.5, 0.7, 1.0)
# Thresholds of a declared lesion among which the check chooses.
LEAST = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5)


@dataclass(frozen=True, eq=False)
class Slide:
    """A recorded slide, lengths in tip radii.

    Fields:
        map: of the sites
        site: of each reading; -1 for a tip that hardly touches                (n_step,)
        reading: see `SlideMemory`                                             (n_step, n)
        place: of the tip                                                      (n_step, 2)
        lesions: places and radii                                              (k, 3)
    """

    map: TouchMap
    site: NDArray[np.intp]
    reading: NDArray[np.float64]
    place: NDArray[np.float64]
    lesions: NDArray[np.float64]

    @classmethod
    def of(cls, slices: dict[str, slice], observations: NDArray[np.floating], rows: NDArray[np.float64]) -> "Slide":
        """Slide of observations (n_step, n_observation) and a true map, as an action declares it (LESIONS_MOST, 4)."""
        memory = SlideMemory(slices, observations[0])
        site, reading, place = [memory.site], [memory.reading], [memory.place]
        for observation in observations[1:]:
            memory.add(observation)
            site.append(memory.site)
            reading.append(memory.reading)
            place.append(memory.place)
        shown = rows[rows[:, 0] > 0.0]
        lesions = np.column_stack([0.5 * (shown[:, 1:3] + 1.0) * memory.map.extent, shown[:, 3] + 1.0])
        return cls(memory.map, np.array(site), np.array(reading), np.array(place), lesions)

    def raster(self, steps: int, *, remembers: bool) -> NDArray[np.float32]:
        """The network's input after so many control steps."""
        kept = slice(0 if remembers else steps, steps + 1)
        felt = self.site[kept] >= 0
        sums = np.zeros((MAP_SIDE * MAP_SIDE, self.reading.shape[1]))
        np.add.at(sums, self.site[kept][felt], self.reading[kept][felt])
        return rasterised(sums.T, self.place[steps], self.map.sites, self.map.pressable)

    def labels(self, steps: int) -> NDArray[np.float32]:
        """Maps of the lesions' places and areas, and of the oracle's next place, 0 without one."""
        away = np.linalg.norm(self.map.sites[:, None] - self.lesions[:, :2], axis=2)
        spots = np.exp(-0.5 * np.square(away / SPOT)).max(axis=1, initial=0.0)
        areas = (away <= self.lesions[:, 2]).any(axis=1)
        goal = np.zeros(len(spots))
        way = np.linalg.norm(self.place[: steps + 1, None] - self.lesions[:, :2], axis=2)
        touched = ((way < REACHED) & (self.site[: steps + 1, None] >= 0)).any(axis=0)
        if not touched.all():
            goal = np.exp(-0.5 * np.square(away[:, np.where(touched, np.inf, way[-1]).argmin()] / SPOT))
            goal /= goal.sum()
        return np.stack([spots, areas, goal]).reshape(3, MAP_SIDE, MAP_SIDE).astype(np.float32)


def load_slides(name: str) -> list[Slide]:
    """The slides of a Minari data set."""
    import minari

    dataset = minari.load_dataset(name)
    env: Any = dataset.recover_environment()
    return [
        Slide.of(env.unwrapped.observation_slices, episode.observations, true_map(episode.infos))
        for episode in dataset.iterate_episodes()
    ]


def true_map(infos: dict[str, Any]) -> NDArray[np.float64]:
    """The true map in the last infos of an episode, as an action declares it (LESIONS_MOST, 4)."""
    return np.array(
        [
            [infos[f"lesion_{number}_{part}"][-1] for part in ("presence", "across", "along", "radius")]
            for number in range(1, LESIONS_MOST + 1)
        ],
        dtype=np.float64,
    )


def score_of(slide: Slide, points: NDArray[np.float64]) -> float:
    """The environment's score of declared places [tip radii] (k, 2) of LESION_RADIUS."""
    declared = np.column_stack([points, np.full(len(points), LESION_RADIUS)])
    cutoff = ospa_cutoff(1.0)
    return map_score(*map_errors(slide.map.sites, slide.lesions, declared, cutoff), cutoff)


def check(network: SlideNetwork, slides: Sequence[Slide]) -> dict[float, list[float]]:
    """Mean score of the network's maps at MOMENTS of the slides, by threshold."""
    scores: dict[float, list[float]] = {least: [] for least in LEAST}
    for moment in MOMENTS:
        heats = []
        for slide in slides:
            inputs = slide.raster(round(moment * (len(slide.site) - 1)), remembers=bool(network.remembers))
            with torch.no_grad():
                heats.append(torch.sigmoid(network(torch.as_tensor(inputs)[None])[0, 0]).numpy().ravel())
        for least, values in scores.items():
            found = [declared_lesions(heat, slide.map.sites, least) for heat, slide in zip(heats, slides, strict=True)]
            values.append(float(np.mean([score_of(*pair) for pair in zip(slides, found, strict=True)])))
    return scores


def mirrored(inputs: NDArray[np.float32], labels: NDArray[np.float32], axis: int) -> tuple[Any, Any]:
    """Example of the mirror image across an axis of the chart: 0 across, 1 along."""
    # The rows of a map are along the chart's second axis.
    inputs, labels = (np.flip(values, axis=2 - axis).copy() for values in (inputs, labels))
    inputs[[FORCE + axis, NORMAL + axis]] *= -1.0
    side = round((len(inputs[TAXELS]) / 3) ** 0.5)
    taxels = np.flip(inputs[TAXELS].reshape(side, side, 3, MAP_SIDE, MAP_SIDE), axis=1 - axis).copy()
    taxels[:, :, axis] *= -1.0
    inputs[TAXELS] = taxels.reshape(inputs[TAXELS].shape)
    return inputs, labels


def examples(slides: Sequence[Slide], rng: np.random.Generator, *, remembers: bool) -> Iterator[tuple[Any, Any]]:
    """Batches of inputs and labels at random moments of random slides, half of them mirrored on each axis."""
    while True:
        batch = []
        for slide in (slides[number] for number in rng.integers(len(slides), size=BATCH)):
            steps = int(rng.integers(min(STEPS_LEAST, len(slide.site) - 1), len(slide.site)))
            example = slide.raster(steps, remembers=remembers), slide.labels(steps)
            for axis in np.flatnonzero(rng.random(2) < 0.5).tolist():
                example = mirrored(*example, axis)
            batch.append(example)
        inputs, labels = (torch.as_tensor(np.stack(values)) for values in zip(*batch, strict=True))
        yield inputs, labels


def train(
    slides: Sequence[Slide], checked: Sequence[Slide], *, steps: int, seed: int, without: str | None = None
) -> SlideNetwork:
    """Train a network; prints its loss and its check."""
    torch.manual_seed(seed)
    rng, remembers = np.random.default_rng(seed), without != "memory"
    batches = examples(slides, rng, remembers=remembers)
    first = torch.cat([next(batches)[0] for _ in range(4)])
    network = SlideNetwork(first.shape[1])
    scale = first.square().mean(dim=(0, 2, 3)).sqrt()
    scale[scale == 0.0] = torch.inf
    if without == "taxels":
        scale[TAXELS] = torch.inf
    network.scale, network.remembers = scale, torch.tensor(float(remembers))
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    for step in range(1, steps + 1):
        inputs, labels = next(batches)
        logits = network(inputs)
        places, areas = (
            functional.binary_cross_entropy_with_logits(logits[:, part], labels[:, part]) for part in (0, 1)
        )
        chances = functional.log_softmax(logits[:, 2].flatten(1), dim=1)
        goal = -(chances * labels[:, 2].flatten(1)).sum(dim=1).mean()
        loss = WEIGHTS[0] * places + WEIGHTS[1] * areas + WEIGHTS[2] * goal
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if step % 200 == 0 or step == steps:
            network.eval()
            scores = {least: sum(values) / len(values) for least, values in check(network, checked).items()}
            best = max(scores, key=scores.__getitem__)
            lost = float(loss.detach())
            print(f"step {step}: loss {lost:.3f}, check {scores[best]:.3f} at threshold {best}", flush=True)
            network.train()
    return network.eval()


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", help="Minari data sets of the training split")
    parser.add_argument("--check", required=True, help="Minari data set of the validation split")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--without", choices=("taxels", "memory"))
    parser.add_argument("--out", type=Path, required=True, help="NAME.safetensors")
    options = parser.parse_args()
    slides = [slide for name in options.datasets for slide in load_slides(name)]
    network = train(slides, load_slides(options.check), steps=options.steps, seed=options.seed, without=options.without)
    with output_folder(options.out.parent, [options.out.name]) as files:
        (files / options.out.name).write_bytes(safetensors.torch.save(network.state_dict()))


if __name__ == "__main__":
    sys.exit(exit_status(main))
