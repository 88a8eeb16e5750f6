"""A learned agent for SurgSim/Slide-v0: a convolutional network maps its spatial memory to lesions and the next place.

After Gupta et al. 2017, "Cognitive mapping and planning for visual navigation": readings are written on a map, and a
network (Ronneberger, Fischer & Brox 2015, "U-Net") reads it.
"""

from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from surgsim_apps.training.slide_agents import LESION_RADIUS, PRESS, SlideMemory, SlideSweep, Way, lesion_numbers
from surgsim_env.palpation import LESIONS_MOST, MAP_SIDE
from surgsim_env.scene import agents_folder

WEIGHTS = agents_folder() / "policies" / "slide_learned.safetensors"
# First channels of the force and of the normal, and those of the taxels; the last four are the number of readings, the
# masks of visited sites and of the face, and the tip.
FORCE, NORMAL, TAXELS = 3, 6, slice(10, -4)
# Radius of the tip's spot on the map, and that of a declared lesion's place about a maximum [tip radii].
SPOT, CENTROID_RADIUS = 1.0, 1.0
# Least distance between declared lesions [tip radii].
DISTANCE_LEAST = 2.0
# Control steps between two maps.
DECISION = 5
# Least distance of a goal from readings and earlier goals [tip radii], and logits that a tip radius of way costs. Both
# and the threshold of `SlideLearned` were chosen on the validation split.
FRESH, WAY_COST = 1.2, 0.3


def raster(memory: SlideMemory, *, remembers: bool = True) -> NDArray[np.float32]:
    """The network's input, (n_channel, MAP_SIDE, MAP_SIDE); without memory the last reading alone."""
    sums = memory.sums
    if not remembers:
        sums = np.zeros_like(sums)
        sums[:, memory.site] = memory.reading if memory.site >= 0 else 0.0
    return rasterised(sums, memory.place, memory.map.sites, memory.map.pressable)


def rasterised(
    sums: NDArray[np.float64], place: NDArray[np.float64], sites: NDArray[np.float64], face: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """The network's input from a memory's sums (n, n_site), the tip's place (2,) [tip radii], sites and face."""
    visited = sums[0] > 0.0
    means = np.divide(sums[1:], sums[0], out=np.zeros_like(sums[1:]), where=visited)
    if visited.any():
        # An organ's modulus says nothing of its lesions.
        means[0, visited] -= means[0, visited].mean()
    spot = np.exp(-np.square(sites - place).sum(axis=1) / (2.0 * SPOT * SPOT))
    further = [np.minimum(sums[0], 10.0) / 5.0, visited, face, spot]
    return np.concatenate([means, further]).reshape(-1, MAP_SIDE, MAP_SIDE).astype(np.float32)


class SlideNetwork(nn.Module):
    """U-Net of three levels with three output maps: lesions' places, their areas, the place to go to (logits)."""

    def __init__(self, channels: int, width: int = 24) -> None:
        super().__init__()
        # Root mean square of each channel; infinite for one that is left out.
        self.scale: torch.Tensor
        self.remembers: torch.Tensor
        self.register_buffer("scale", torch.ones(channels))
        self.register_buffer("remembers", torch.tensor(1.0))
        self.first = nn.Sequential(nn.Conv2d(channels, width, 1), nn.SiLU(), *_convolutions(width, width, width))
        self.second = _convolutions(width, 2 * width, 2 * width)
        self.third = _convolutions(2 * width, 4 * width, 2 * width)
        self.to_second = _convolutions(4 * width, 2 * width)
        self.to_first = _convolutions(3 * width, width)
        self.last = nn.Conv2d(width, 3, 1)

    def forward(self, rasters: torch.Tensor) -> torch.Tensor:
        """Logits (n, 3, MAP_SIDE, MAP_SIDE) for rasters (n, n_channel, MAP_SIDE, MAP_SIDE)."""
        fine = self.first(rasters / self.scale[:, None, None])
        middle = self.second(functional.avg_pool2d(fine, 2, ceil_mode=True))
        coarse = self.third(functional.avg_pool2d(middle, 2, ceil_mode=True))
        middle = self.to_second(torch.cat([middle, _resized(coarse, middle)], dim=1))
        return self.last(self.to_first(torch.cat([fine, _resized(middle, fine)], dim=1)))


def _convolutions(*sizes: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        parts += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.GroupNorm(4, outputs), nn.SiLU()]
    return nn.Sequential(*parts)


def _resized(values: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    return functional.interpolate(values, size=like.shape[-2:], mode="bilinear")


@cache
def load_network(path: Path) -> SlideNetwork:
    """The network of a file of weights."""
    weights = safetensors.torch.load_file(path)
    width = weights["last.weight"].shape[1]
    network = SlideNetwork(len(weights["scale"]), width)
    network.load_state_dict(weights)
    return network.eval()


def declared_lesions(heat: NDArray[np.floating], sites: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """Places of the lesions [tip radii] (k, 2): maxima of a map of probabilities (n_site,) above the least one.

    The highest first, each at the centroid of the map around it.
    """
    left, places = np.array(heat, dtype=np.float64), []
    while len(places) < LESIONS_MOST and left.max() >= least:
        squared = np.square(sites - sites[left.argmax()]).sum(axis=1)
        weight = heat * (squared <= CENTROID_RADIUS * CENTROID_RADIUS)
        places.append(weight @ sites / weight.sum())
        left[squared <= DISTANCE_LEAST * DISTANCE_LEAST] = 0.0
    return np.array(places).reshape(-1, 2)


class SlideLearned(SlideSweep):
    """Slides where the network expects a lesion that it has not touched, and declares the lesions that it sees."""

    weights = WEIGHTS
    # Least probability of a declared lesion.
    least = 0.2

    def reset(self, rng: np.random.Generator, facts: Any) -> None:
        """Begin an episode."""
        super().reset(rng, facts)
        self.network = load_network(self.weights)
        self.way, self.goals = Way(np.zeros((0, 2))), np.zeros((0, 2))

    def act(self, observation: NDArray[np.floating]) -> NDArray[np.float32]:
        """The next action."""
        if self.memory is None:
            self.memory = SlideMemory(self.slices, observation)
        else:
            self.memory.add(observation)
        memory = self.memory
        velocity = self.way.velocity(memory.place)
        if memory.steps % DECISION == 1 or self.way.goal is None:
            with torch.no_grad():
                maps = self.network(torch.as_tensor(raster(memory, remembers=bool(self.network.remembers)))[None])[0]
            points = declared_lesions(torch.sigmoid(maps[0]).numpy().ravel(), memory.map.sites, self.least)
            self.declared = lesion_numbers(points, np.full(len(points), LESION_RADIUS), memory.map.extent)
            if self.way.goal is None:
                self._choose(memory, maps[2].numpy().ravel())
                velocity = self.way.velocity(memory.place)
        # Without a fresh place left the tip lifts: a rest on the tissue doses it.
        press = -1.0 if self.way.goal is None else PRESS
        return np.concatenate([np.clip(velocity, -1.0, 1.0), [press], self.declared]).astype(np.float32)

    def _choose(self, memory: SlideMemory, logits: NDArray[np.floating]) -> None:
        """Choose the next goal among the sites far from all readings and all goals before."""
        sites = memory.map.sites
        known = np.concatenate([sites[memory.visited], self.goals])
        squared = np.square(sites[:, None] - known).sum(axis=2).min(axis=1, initial=np.inf)
        worth = logits - WAY_COST * np.linalg.norm(sites - memory.place, axis=1)
        worth[~memory.map.pressable | (squared <= FRESH * FRESH)] = -np.inf
        if np.isfinite(worth.max()):
            goal = sites[worth.argmax()][None]
            self.goals, self.way = np.concatenate([self.goals, goal]), Way(goal)
