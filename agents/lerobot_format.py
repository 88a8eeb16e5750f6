"""Episodes as files of the LeRobot data set format v2.1, one episode at a time: a recording that was stopped goes on.

    meta/info.json             totals, splits, features with units and frames; under "surgsim" what made the episodes
    meta/README.md             the same features as a table
    meta/episodes.jsonl        length, task, seed and success of each episode
    meta/episodes_stats.jsonl  least, largest, mean value and standard deviation of each feature in each episode
    meta/tasks.jsonl           the task in words
    data/chunk-000/episode_000000.parquet
    videos/chunk-000/observation.images.endoscope/episode_000000.mp4

meta/info.json is replaced last: what it does not count is no part of the data set, and is removed when it is opened
again. A split is a range of episodes, so that successes come first: failures wait in `failures/`, which no reader looks
into, until `finish` appends them; `LeRobotFolder` takes them back if the recording goes on after that.
"""

import fcntl
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

VERSION = "v2.1"
CHUNK_SIZE = 1000
DATA_PATH = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
VIDEO_PATH = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
INFO, EPISODES, STATS, TASKS = "meta/info.json", "meta/episodes.jsonl", "meta/episodes_stats.jsonl", "meta/tasks.jsonl"
README, FAILURES = "meta/README.md", "failures"
# Names of files and folders that are being written end with it.
PART = ".part"
# H.264 that any player shows; a key frame every second picture, as in LeRobot's own videos, so that single pictures are
# found quickly; no pictures out of order, whose times would begin after 0.
CODEC = ["-g", "2", "-bf", "0", "-crf", "23", "-preset", "veryfast", "-threads", "1"]
# Pictures of an episode, and every so many pixels of their rows and columns, that its statistics are of.
PICTURES_MOST, PIXEL_STEP = 100, 2


@dataclass(frozen=True)
class Feature:
    """A named quantity of each frame.

    Args:
        name: such as "observation.state".
        dtype: "float32", "int64", "bool", or "video" for pictures.
        shape: of one frame: (size,), or (height, width, 3) of a picture.
        names: of the entries, or of the axes of a picture; None without.
        info: what the entries are: units, frame, meaning.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None = None
    info: Mapping[str, Any] = field(default_factory=dict)

    def column(self, values: NDArray) -> pa.Array:
        """Values (n, size) or (n,) as a column: of scalars for size 1, as the format asks, else of lists of fixed size.

        Raises:
            ValueError: values of another shape or type.
        """
        values = np.asarray(values)
        if values.dtype != self.dtype or values.shape not in {(len(values), *self.shape), (len(values),)}:
            raise ValueError(
                f"{self.name} is {values.dtype} of shape {values.shape}; the rule is {self.dtype} of shape "
                f"{(len(values), *self.shape)}: convert it"
            )
        flat = pa.array(np.ascontiguousarray(values).ravel())
        return flat if self.shape == (1,) else pa.FixedSizeListArray.from_arrays(flat, self.shape[0])

    def described(self) -> dict[str, Any]:
        """The feature as info.json has it."""
        names = None if self.names is None else list(self.names)
        described = {"dtype": self.dtype, "shape": list(self.shape), "names": names}
        return described | ({"info": dict(self.info)} if self.info else {})


# What the format itself asks for.
COUNTED = (
    Feature("timestamp", "float32", (1,), info={"units": "s", "meaning": "simulated time since the episode began"}),
    *(Feature(name, "int64", (1,)) for name in ("frame_index", "episode_index", "index", "task_index")),
)


class LeRobotFolder:
    """A data set in a folder, which one process at a time writes.

    Fields:
        path: the folder
        recorded: under "surgsim" in info.json: what made the episodes; equal where a recording goes on
        next_seed: first seed that was not played yet
        episode_count, frame_count: of the data set, failures that wait excluded
        waiting: failures that wait for `finish`, by seed: their numbers of frames
    """

    def __init__(
        self,
        path: Path,
        features: Sequence[Feature],
        *,
        frame_rate: int,
        robot: str,
        task: str,
        recorded: Mapping[str, Any],
        first_seed: int,
    ) -> None:
        """Begin a data set in a new or empty folder, or go on with the one that is there.

        Args:
            path: the folder.
            features: of each frame, without those that the format asks for.
            frame_rate: frames per second of simulated time.
            robot: name of the instrument.
            task: what the episodes show, as an instruction in words.
            recorded: what made the episodes.
            first_seed: the first to be played.

        Raises:
            ValueError: a folder with something else, or with episodes that were made otherwise (names the entry);
                another process writes into it.
        """
        self.path, self.frame_rate = path, frame_rate
        self._features = (*features, *COUNTED)
        self._videos = [feature for feature in features if feature.dtype == "video"]
        self.recorded = json.loads(json.dumps({**recorded, "task": task}))
        self.episode_count = self.frame_count = self._success_count = 0
        self.waiting: dict[int, int] = {}
        self.next_seed = first_seed
        self._fixed = {
            "codebase_version": VERSION,
            "robot_type": robot,
            "total_tasks": 1,
            "chunks_size": CHUNK_SIZE,
            "fps": frame_rate,
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH if self._videos else None,
            "features": {feature.name: feature.described() for feature in self._features},
        }
        path.mkdir(parents=True, exist_ok=True)
        # Held until the process ends, or `close`.
        self._lock = os.open(path, os.O_RDONLY)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if (path / INFO).exists():
                self._open()
            elif any(not one.name.endswith(PART) for one in path.iterdir() if one.name != "meta"):
                raise ValueError(f"{path} holds files and no {INFO}: name an empty folder, or a new one")
            else:
                self._begin(task)
        except BlockingIOError:
            self.close()
            raise ValueError(f"another process writes into {path}: wait for its end, or name another folder") from None
        except BaseException:
            self.close()
            raise

    @property
    def feature_names(self) -> list[str]:
        """Names of all features."""
        return [feature.name for feature in self._features]

    def close(self) -> None:
        """Let other processes write; may be called repeatedly."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    @property
    def duration(self) -> float:
        """Simulated time of all episodes, failures that wait included [s]."""
        return (self.frame_count + sum(self.waiting.values())) / self.frame_rate

    def add(self, seed: int, values: Mapping[str, NDArray], *, success: bool) -> None:
        """Add the episode of `next_seed`: a success to the data set, a failure to those that wait for `finish`.

        Args:
            seed: of the episode.
            values: of each feature but those that the format asks for, shape (n_frame, *shape); pictures are uint8.
            success: whether the task was solved.

        Raises:
            ValueError: another seed than the next, no frame, or values that are not those of the features.
        """
        self._take(seed)
        length = len(values["action"])
        if not length:
            raise ValueError(f"the episode of seed {seed} has no frame: call skip({seed})")
        counted = {
            "timestamp": (np.arange(length) / self.frame_rate).astype(np.float32),
            "frame_index": np.arange(length),
            "task_index": np.zeros(length, dtype=np.int64),
        }
        stated = [one for one in self._features if one.name not in ("episode_index", "index") and one.dtype != "video"]
        given = {**values, **counted}
        table = pa.table({one.name: one.column(given[one.name]) for one in stated})
        line = {"tasks": [self.recorded["task"]], "length": length, "seed": seed, "success": success}
        stats = {one.name: array_stats(np.asarray(given[one.name])) for one in stated}
        stats |= {one.name: picture_stats(values[one.name]) for one in self._videos}
        # Every episode is written as a folder of its own first, which appears with all it holds.
        part = self.path / f"seed_{seed:09d}{PART}"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        pq.write_table(table, part / "frames.parquet")
        for one in self._videos:
            write_video(part / f"{one.name}.mp4", values[one.name], self.frame_rate)
        (part / "line.json").write_text(json.dumps({"line": line, "stats": stats}))
        if success:
            self._append(part)
        else:
            self._wait(part, seed, length)
        self.next_seed = seed + 1
        self._commit()
        shutil.rmtree(part, ignore_errors=True)

    def skip(self, seed: int) -> None:
        """Note that the episode of `next_seed` was played and is not kept."""
        self._take(seed)
        self.next_seed = seed + 1
        self._commit()

    def finish(self) -> None:
        """Append the failures that wait; an interrupted call is made again."""
        places = [self._waiting_place(seed) for seed in sorted(self.waiting)]
        for place in places:
            self._append(place)
        self.waiting = {}
        self._commit()
        for place in places:
            shutil.rmtree(place)
        if places:
            (self.path / FAILURES).rmdir()

    # ---- files -------------------------------------------------------------------------------------------------

    def _begin(self, task: str) -> None:
        self._replace(TASKS, json.dumps({"task_index": 0, "task": task}) + "\n")
        self._replace(EPISODES, "")
        self._replace(STATS, "")
        self._replace(README, self._readme(task))
        self._commit()

    def _open(self) -> None:
        """Read the totals, remove what they do not count, and take failures back to where they wait."""
        info = json.loads((self.path / INFO).read_text())
        for what, mine, found in (
            *((name, value, info.get(name)) for name, value in self._fixed.items()),
            *((name, value, info.get("surgsim", {}).get(name)) for name, value in self.recorded.items()),
        ):
            if json.loads(json.dumps(mine)) != found:
                raise ValueError(
                    f"{self.path} holds episodes whose {what} is {_short(found)}, not {_short(mine)}: give the same "
                    "arguments and code to go on, or name another folder"
                )
        self.episode_count, self.frame_count = info["total_episodes"], info["total_frames"]
        self._success_count = int(info["splits"]["success"].partition(":")[2])
        self.next_seed = info["surgsim"]["next_seed"]
        self._remove_uncounted()
        lines = self._lines(EPISODES)
        appended = {line["seed"] for line in lines[self._success_count :]}
        for place in sorted((self.path / FAILURES).glob("seed_*")):
            seed = int(place.name.removeprefix("seed_"))
            if seed in appended or seed >= self.next_seed:
                shutil.rmtree(place)
            else:
                self.waiting[seed] = json.loads((place / "line.json").read_text())["line"]["length"]
        self._take_back(lines)

    def _take_back(self, lines: list[dict[str, Any]]) -> None:
        """Let the failures that were appended wait again, as successes may follow."""
        stats = self._lines(STATS)
        for index in range(self._success_count, self.episode_count):
            line = lines[index]
            part = self.path / f"seed_{line['seed']:09d}{PART}"
            part.mkdir()
            table = pq.read_table(self._data_place(index)).drop_columns(["episode_index", "index"])
            pq.write_table(table, part / "frames.parquet")
            for one in self._videos:
                link(self._video_place(one, index), part / f"{one.name}.mp4")
            kept = {name: value for name, value in line.items() if name != "episode_index"}
            own = {name: value for name, value in stats[index]["stats"].items() if name not in _PLACED}
            (part / "line.json").write_text(json.dumps({"line": kept, "stats": own}))
            self._wait(part, line["seed"], line["length"])
        if self.episode_count > self._success_count:
            self.episode_count = self._success_count
            self.frame_count = sum(line["length"] for line in lines[: self._success_count])
            self._commit()
            self._remove_uncounted()

    def _wait(self, part: Path, seed: int, length: int) -> None:
        """Let an episode's folder wait under the name of its seed."""
        place = self._waiting_place(seed)
        place.parent.mkdir(exist_ok=True)
        part.replace(place)
        self.waiting[seed] = length

    def _append(self, place: Path) -> None:
        """Put the files of an episode's folder where the next episode's lie; `_commit` makes it count."""
        kept = json.loads((place / "line.json").read_text())
        line, index = kept["line"], self.episode_count
        length = line["length"]
        table = pq.read_table(place / "frames.parquet")
        placed = {
            "episode_index": np.full(length, index, dtype=np.int64),
            "index": np.arange(self.frame_count, self.frame_count + length),
        }
        table = pa.table({one.name: placed.get(one.name) if one.name in placed else table[one.name]
                          for one in self._features if one.dtype != "video"})  # fmt: skip
        data = self._data_place(index)
        data.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, data.with_name(data.name + PART))
        data.with_name(data.name + PART).replace(data)
        for one in self._videos:
            video = self._video_place(one, index)
            video.parent.mkdir(parents=True, exist_ok=True)
            link(place / f"{one.name}.mp4", video)
        stats = kept["stats"] | {name: array_stats(values) for name, values in placed.items()}
        self._add_line(EPISODES, {"episode_index": index, **line})
        self._add_line(STATS, {"episode_index": index, "stats": stats})
        self.episode_count, self.frame_count = index + 1, self.frame_count + length
        self._success_count += line["success"]

    def _commit(self) -> None:
        """Replace info.json, which says what is part of the data set."""
        successes = f"0:{self._success_count}"
        splits = {"train": successes, "success": successes}
        if self.episode_count > self._success_count:
            splits["failure"] = f"{self._success_count}:{self.episode_count}"
        info = {
            **{name: self._fixed[name] for name in ("codebase_version", "robot_type")},
            "total_episodes": self.episode_count,
            "total_frames": self.frame_count,
            "total_videos": self.episode_count * len(self._videos),
            "total_chunks": math.ceil(self.episode_count / CHUNK_SIZE),
            "splits": splits,
            **self._fixed,
            "surgsim": {**self.recorded, "next_seed": self.next_seed},
        }
        self._replace(INFO, json.dumps(info, indent=4) + "\n")

    def _remove_uncounted(self) -> None:
        """Remove lines and files of episodes that info.json does not count."""
        for part in self.path.glob(f"seed_*{PART}"):
            shutil.rmtree(part)
        for name in (EPISODES, STATS):
            text = (self.path / name).read_text()
            kept = "".join(text.splitlines(keepends=True)[: self.episode_count])
            if kept != text:
                self._replace(name, kept)
        for folder in ("data", "videos"):
            for file in (self.path / folder).rglob("episode_*"):
                number = file.name.removeprefix("episode_").partition(".")[0]
                if file.name.endswith(PART) or int(number) >= self.episode_count:
                    file.unlink()

    def _take(self, seed: int) -> None:
        if seed != self.next_seed:
            raise ValueError(f"seed {seed} is not the next to be recorded, which is {self.next_seed}")

    def _lines(self, name: str) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.path / name).read_text().splitlines()]

    def _add_line(self, name: str, line: Mapping[str, Any]) -> None:
        with (self.path / name).open("a") as file:
            file.write(json.dumps(line) + "\n")

    def _replace(self, name: str, text: str) -> None:
        place = self.path / name
        place.parent.mkdir(parents=True, exist_ok=True)
        part = place.with_name(place.name + PART)
        part.write_text(text)
        part.replace(place)

    def _data_place(self, index: int) -> Path:
        return self.path / DATA_PATH.format(episode_chunk=index // CHUNK_SIZE, episode_index=index)

    def _video_place(self, feature: Feature, index: int) -> Path:
        chunk = index // CHUNK_SIZE
        return self.path / VIDEO_PATH.format(episode_chunk=chunk, video_key=feature.name, episode_index=index)

    def _waiting_place(self, seed: int) -> Path:
        return self.path / FAILURES / f"seed_{seed:09d}"

    def _readme(self, task: str) -> str:
        return "\n".join([
            "# Recorded in surgsim, a soft-tissue simulator for surgical robots",
            "",
            f"Task: {task} LeRobot data set {VERSION}, {self.frame_rate} frames per second of simulated time.",
            "",
            "A frame holds an observation, the action that followed, and under `next.` its results. All values",
            "of a frame are of one moment of the simulation: they are synchronous by construction, and `timestamp` is",
            "frame_index / fps without jitter.",
            "",
            "| feature | type | shape | entries | units | frame | meaning |",
            "|---|---|---|---|---|---|---|",
            *self._feature_rows(),
            "",
            "Splits (`info.json`): `success` (the same as `train`) and `failure` are ranges of episodes.",
            "",
        ])  # fmt: skip

    def _feature_rows(self) -> Iterator[str]:
        for one in self._features:
            names = ", ".join(one.names or ())
            parts = [one.info.get(name, "") for name in ("units", "frame", "meaning")]
            shown = [", ".join(part) if isinstance(part, list | tuple) else str(part) for part in parts]
            yield f"| `{one.name}` | {one.dtype} | {list(one.shape)} | {names} | {' | '.join(shown)} |"


_PLACED = ("episode_index", "index")


def array_stats(values: NDArray) -> dict[str, list[Any]]:
    """Least, largest, mean value and standard deviation of each entry of values (n, size) or (n,), and n."""
    table = values.reshape(len(values), -1)
    numbers = table.astype(np.float64)
    return {
        "min": table.min(axis=0).tolist(),
        "max": table.max(axis=0).tolist(),
        "mean": numbers.mean(axis=0).tolist(),
        "std": numbers.std(axis=0).tolist(),
        "count": [len(values)],
    }


def picture_stats(pictures: NDArray[np.uint8]) -> dict[str, list[Any]]:
    """The same of each colour of pictures (n, height, width, 3), from 0 to 1, shape (3, 1, 1); of some of them."""
    chosen = np.unique(np.linspace(0, len(pictures) - 1, min(len(pictures), PICTURES_MOST)).round().astype(int))
    colours = pictures[chosen, ::PIXEL_STEP, ::PIXEL_STEP].reshape(-1, 3) / 255.0
    found = {"min": colours.min(0), "max": colours.max(0), "mean": colours.mean(0), "std": colours.std(0)}
    return {name: value.reshape(3, 1, 1).tolist() for name, value in found.items()} | {"count": [len(chosen)]}


def link(source: Path, place: Path) -> None:
    """Let a file have a second name; where the file system has no such names, copy it."""
    place.unlink(missing_ok=True)
    try:
        os.link(source, place)
    except OSError:
        shutil.copyfile(source, place)


def write_video(path: Path, pictures: NDArray[np.uint8], frame_rate: int) -> None:
    """Write pictures (n, height, width, 3) as an H.264 file whose picture k is shown at k / frame_rate [s]."""
    import imageio_ffmpeg

    height, width = pictures.shape[1:3]
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=frame_rate, codec="libx264", macro_block_size=2, output_params=CODEC
    )
    writer.send(None)
    for picture in pictures:
        writer.send(np.ascontiguousarray(picture))
    writer.close()


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 200 else f"{text[:200]} ..."
