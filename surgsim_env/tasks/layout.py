"""Entries of a task's actions and observations: slices by name, bounds and scales, from its declaration."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from msdm_core.arithmetic import matmul
from msdm_core.mesh.tet_mesh import FloatArray
from surgsim_env.coupling.simulation import Simulation
from surgsim_env.instruments.instrument import Instrument
from surgsim_env.tasks.declaration import Channel, Command, real_numbers
from surgsim_env.tasks.task import Task


class TaskLayout:
    """Layout of a task's actions and observations.

    Fields:
        action_slices: entries of an action, by the command's name
        observation_slices: entries of an observation, by the channel's name
        observed: channels of an observation, with their sizes
        sensed: those with a sensor, with their sizes
    """

    def __init__(self, task: Task) -> None:
        """Lay out the commands and channels of a task; those of size 0 are left out."""
        self._task = task
        self.action_slices = _slices((command.name, _size(command, task)) for command in task.commands)
        self._commands = {command.name: command for command in task.commands if command.name in self.action_slices}
        sized = ((channel, _size(channel, task)) for channel in task.channels)
        self.observed: tuple[tuple[Channel, int], ...] = tuple((channel, size) for channel, size in sized if size)
        self.observation_slices = _slices((channel.name, size) for channel, size in self.observed)
        self.sensed = tuple((channel, size) for channel, size in self.observed if channel.sensor or channel.taxels)

    def __reduce__(self) -> tuple[Any, ...]:
        """The task, laid out anew: the functions of its class's declaration cannot be pickled."""
        return TaskLayout, (self._task,)

    # ---- actions -----------------------------------------------------------------------------------------------

    @property
    def action_size(self) -> int:
        """Entries of an action, each in [-1, 1]."""
        return max(part.stop for part in self.action_slices.values())

    @property
    def speed_limit(self) -> float:
        """Largest tip velocity of an action along an axis [m/s]."""
        return self._commands["velocity"].scale

    def action(self, velocity: FloatArray | None = None, **commands: Any) -> FloatArray:
        """The action of commands in SI units and on the world's axes, shape (action_size,).

        Those left out, or None, have their default, else 0.

        Raises:
            TypeError: an unknown command (lists the task's commands).
        """
        given = {"velocity": velocity, **commands}
        for name, value in given.items():
            if value is not None and name not in self._commands:
                raise TypeError(
                    f"{type(self._task).__name__} has no command {name!r}; its commands are "
                    f"{', '.join(self.action_slices)}"
                )
        values = np.zeros(self.action_size)
        for name, command in self._commands.items():
            value = given.get(name)
            if value is None and command.default is not None:
                value = command.default(self._task)
            elif value is not None and (axes := _axes(command, self._task)) is not None:
                value = matmul(np.asarray(value, dtype=np.float64), axes.T)
            if value is not None:
                values[self.action_slices[name]] = np.asarray(value, dtype=np.float64) / command.scale
        return values

    def commands(self, action: FloatArray) -> dict[str, FloatArray]:
        """Commands of an action (action_size,) in SI units and on the world's axes, by name, shape (size,) each."""
        values = {}
        for name, command in self._commands.items():
            value = np.asarray(action[self.action_slices[name]], dtype=np.float64) * command.scale
            axes = _axes(command, self._task)
            values[name] = value if axes is None else matmul(value, axes)
        return values

    # ---- observations ------------------------------------------------------------------------------------------

    @property
    def force_entries(self) -> list[int]:
        """Indices of the observation's entries from force sensing: those of the channels marked `felt`."""
        felt = [channel.felt for channel, size in self.observed for _ in range(size)]
        return np.flatnonzero(felt).tolist()

    def entry_name(self, index: int) -> str:
        """Name of an entry of the observation, by channel and index: "contact_force[2]"."""
        names = [f"{channel.name}[{place}]" for channel, size in self.observed for place in range(size)]
        return names[index]

    def read(self, simulation: Simulation) -> FloatArray:
        """The observation (n_observation,) in SI units, with the last readings of the sensors.

        Raises:
            ValueError: a channel's `read` returns other than real numbers, or another size.
        """
        sensed, names = self._task.sensed, {channel.name for channel, _ in self.sensed}
        return np.concatenate(
            [
                sensed[channel.name] if channel.name in names else self.reading(channel, size, simulation)
                for channel, size in self.observed
            ]
        )

    def reading(self, channel: Channel, size: int, simulation: Simulation) -> FloatArray:
        """Numbers of a channel from the simulation, in front of its sensor, shape (size,).

        Raises:
            ValueError: other than real numbers, or another size.
        """
        assert channel.read is not None
        values = real_numbers(channel.read(self._task, simulation), "channel", channel.name)
        if values.size != size:
            raise ValueError(
                f"channel {channel.name!r}: read returned {values.size} numbers, shape {values.shape}; its size is "
                f"{size}: return that many, or declare another size"
            )
        return values.ravel()

    def bounds(self, instrument: Instrument | None) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the observation with an instrument, shape (n_observation,) each; all finite.

        Raises:
            ValueError: a channel whose bounds are not finite, do not fit its size, or are the wrong way round.
        """
        low, high = self._declared("low", instrument), self._declared("high", instrument)
        for index in np.flatnonzero(low > high).tolist():
            raise ValueError(
                f"channel {self.entry_name(index)}: low is {low[index]:g}, above high {high[index]:g}: swap them"
            )
        return low, high

    def scales(self, instrument: Instrument | None) -> tuple[FloatArray, FloatArray]:
        """Origin and scale of each entry of the observation with an instrument, shape (n_observation,) each.

        An environment observes (value - origin) / scale.

        Raises:
            ValueError: a channel whose origin or scale is not finite, does not fit its size, or a scale not above 0.
        """
        scale = self._declared("scale", instrument)
        for index in np.flatnonzero(scale <= 0.0).tolist():
            raise ValueError(f"channel {self.entry_name(index)}: scale is {scale[index]:g}; it must be above 0")
        return self._declared("origin", instrument), scale

    def _declared(self, field: str, instrument: Instrument | None) -> FloatArray:
        """A bound, the origin or the scale of each entry of the observation, (n_observation,)."""
        values = []
        for channel, size in self.observed:
            declared = getattr(channel, field)
            given = declared(self._task, instrument) if callable(declared) else declared
            value = real_numbers(given, f"{field} of channel", channel.name)
            if value.size not in (1, size) or not np.isfinite(value).all():
                raise ValueError(
                    f"channel {channel.name!r}: {field} is {value.tolist()}; it must be one finite number or {size}, "
                    f"in {channel.unit or 'its own unit'}"
                )
            values.append(np.broadcast_to(value.ravel(), size))
        return np.concatenate(values)


def channel_slices(task_class: type[Task], **sizes: int) -> dict[str, slice]:
    """Slices of a task's observation without an episode; `sizes` are those of channels with a function for a size."""
    given = {channel.name: 0 if callable(channel.size) else channel.size for channel in task_class.channels} | sizes
    return _slices(given.items())


def _axes(command: Command, task: Task) -> FloatArray | None:
    """Axes of a command, unit vectors as rows (3, 3); None for the world's."""
    return None if command.axes is None else command.axes(task)


def _size(part: Command | Channel, task: Task) -> int:
    """The number of entries of a command or channel."""
    return part.size(task) if callable(part.size) else part.size


def _slices(sized: Iterable[tuple[str, Any]]) -> dict[str, slice]:
    """Consecutive slices, by name; names of size 0 have none."""
    slices, first = {}, 0
    for name, size in sized:
        if size:
            slices[name] = slice(first, first + size)
        first += size
    return slices
