"""Exports in the format of LeRobot (version 3): pushes as episodes of 11 frames, in Parquet, pictures as PNG."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dipn_jax.system import files

from . import feature_statistics, steps
from .columns import PIXELS, Values
from .source import SPLITS, Part

TASK = "push"
"""The task of every episode, in words."""
FILES_PER_FOLDER = 1000
"""Number of files in a folder."""
STATISTICS = ("min", "max", "mean", "std", "count")
"""Statistics that are written of every feature, for each episode and for the data set."""
_PICTURES = ("color", "height", "label")
_INDEX = ("timestamp", "frame_index", "episode_index", "index", "task_index")


class LeRobot:
    """A folder that `LeRobotDataset` opens: a file of frames and a file of episodes for each part."""

    def __init__(self, out: pathlib.Path, slots: int, images: str) -> None:
        self.out, self.slots = out, slots
        self.pictures = tuple(f"observation.images.{name}" for name in _PICTURES) if images == "all" else ()
        self._schema = self._frames_schema()

    def features(self) -> dict[str, dict[str, Any]]:
        """Return the features of a frame, as `meta/info.json` has them."""
        slots = [f"{axis}{slot}" for slot in range(self.slots) for axis in ("x", "y", "z", "qw", "qx", "qy", "qz")]
        sizes = [f"{axis}{slot}" for slot in range(self.slots) for axis in ("x", "y", "z")]
        found = {
            "observation.state": _feature("float32", ["x", "y", "angle"]),
            "observation.environment_state": _feature("float32", slots),
            "observation.size": _feature("float32", sizes),
            "action": _feature("float32", ["x", "y", "angle"]),
        }
        picture = {"dtype": "image", "shape": [PIXELS, PIXELS, 3], "names": ["height", "width", "channels"]}
        found |= dict.fromkeys(self.pictures, picture)
        kinds = {"timestamp": "float32"}
        return found | {name: _feature(kinds.get(name, "int64"), None) for name in _INDEX}

    def _path(self, what: str, place: int) -> pathlib.Path:
        folder, file = divmod(place, FILES_PER_FOLDER)
        return self.out / what / f"chunk-{folder:03d}" / f"file-{file:03d}.parquet"

    def done(self, part: Part) -> bool:
        """Return whether a part has been written: its file of episodes is written after that of frames."""
        return self._path("meta/episodes", part.place).exists()

    def write(self, part: Part, blocks: Iterator[Values]) -> None:
        """Write a part: a row group for each episode."""
        said: list[dict[str, Any]] = []
        with (
            files.replacing(self._path("data", part.place)) as path,
            pq.ParquetWriter(path, self._schema, compression="zstd") as writer,
        ):
            for values in blocks:
                stepped = steps.steps("push", values)
                for row, number in enumerate(values["episode"]):
                    frames = self._frames({k: v[row] for k, v in stepped.items()}, values["size"][row], int(number))
                    writer.write_table(self._table(frames), row_group_size=len(frames["index"]))
                    said.append(self._episode(part, int(number), frames))
        self._write_episodes(self._path("meta/episodes", part.place), said)

    def _frames(self, stepped: Values, size: np.ndarray, number: int) -> Values:
        """Return the frames `[T, ...]` of an episode by the name of their feature."""
        count = steps.length("push")
        at = np.arange(count)
        found = {
            "observation.state": stepped["gripper"],
            "observation.environment_state": stepped["poses"].reshape(count, -1),
            "observation.size": np.tile(size.reshape(1, -1), (count, 1)),
            "action": stepped["action"],
        }
        if self.pictures:
            grey = {"height": np.rint(1000 * stepped["height"]).clip(0, 255), "label": stepped["label"] + 1}
            found["observation.images.color"] = stepped["color"]
            for name, value in grey.items():
                found[f"observation.images.{name}"] = np.repeat(value.astype(np.uint8)[..., None], 3, -1)
        found |= {"timestamp": (at / steps.FPS).astype(np.float32), "frame_index": at}
        return found | {
            "episode_index": np.full(count, number),
            "index": number * count + at,
            "task_index": np.zeros(count, np.int64),
        }

    def _frames_schema(self) -> pa.Schema:
        """Return the schema of frames, with the features as the library `datasets` names them."""
        fields, named = list[pa.Field](), dict[str, Any]()
        for name, feature in self.features().items():
            if feature["dtype"] == "image":
                fields.append(pa.field(name, pa.struct([("bytes", pa.binary()), ("path", pa.string())])))
                named[name] = {"_type": "Image"}
                continue
            plain, length = pa.from_numpy_dtype(np.dtype(feature["dtype"])), feature["shape"][0]
            value = {"dtype": feature["dtype"], "_type": "Value"}
            fields.append(pa.field(name, plain if name in _INDEX else pa.list_(plain, length)))
            named[name] = value if name in _INDEX else {"feature": value, "length": length, "_type": "Sequence"}
        return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": named}})})

    def _table(self, frames: Values) -> pa.Table:
        schema, arrays = self._schema, list[pa.Array]()
        for field in schema:
            value = frames[field.name]
            if field.name in self.pictures:
                packed = [cv2.imencode(".png", picture[..., ::-1])[1].tobytes() for picture in value]
                arrays.append(pa.array([{"bytes": one, "path": None} for one in packed], field.type))
            elif field.name in _INDEX:
                arrays.append(pa.array(value, field.type))
            else:
                arrays.append(pa.FixedSizeListArray.from_arrays(pa.array(value.reshape(-1)), type=field.type))
        return pa.Table.from_arrays(arrays, schema=schema)

    def _episode(self, part: Part, number: int, frames: Values) -> dict[str, Any]:
        """Return the row of `meta/episodes` of an episode."""
        count = len(frames["index"])
        found: dict[str, Any] = {"episode_index": number, "tasks": [TASK], "length": count}
        found |= {"dataset_from_index": number * count, "dataset_to_index": (number + 1) * count}
        folder, file = divmod(part.place, FILES_PER_FOLDER)
        for what in ("data", "meta/episodes"):
            found |= {f"{what}/chunk_index": folder, f"{what}/file_index": file}
        for name, value in frames.items():
            its = feature_statistics.of_pictures(value) if name in self.pictures else feature_statistics.of(value)
            found |= {f"stats/{name}/{statistic}": numbers.tolist() for statistic, numbers in its.items()}
        return found

    @staticmethod
    def _write_episodes(path: pathlib.Path, said: list[dict[str, Any]]) -> None:
        table = pa.Table.from_pylist(said)
        sink = pa.BufferOutputStream()
        pq.write_table(table, sink, compression="zstd")
        files.write_atomically(path, sink.getvalue().to_pybytes())

    def finish(self, parts: Sequence[Part]) -> None:
        """Write what describes all: statistics, the task, and `meta/info.json`."""
        joined: dict[str, feature_statistics.Joined] = {name: feature_statistics.Joined() for name in self.features()}
        for part in parts:
            table = pq.read_table(self._path("meta/episodes", part.place))
            for name, all_of_them in joined.items():
                for row in zip(*(table.column(f"stats/{name}/{s}").to_pylist() for s in STATISTICS), strict=True):
                    all_of_them.add(dict(zip(STATISTICS, map(np.asarray, row), strict=True)))
        statistics = {name: {k: v.tolist() for k, v in one.result().items()} for name, one in joined.items()}
        files.write_json(self.out / "meta" / "stats.json", statistics)
        self._write_tasks()
        files.write_json(self.out / "meta" / "info.json", self._info(parts))

    def _write_tasks(self) -> None:
        """Write the table of tasks, whose index in pandas is the task."""
        columns = [{"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}]
        columns.append({"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"})
        about = {"index_columns": ["task"], "column_indexes": [], "columns": [c | {"metadata": None} for c in columns]}
        table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [TASK]})
        sink = pa.BufferOutputStream()
        pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), sink)
        files.write_atomically(self.out / "meta" / "tasks.parquet", sink.getvalue().to_pybytes())

    def _info(self, parts: Sequence[Part]) -> dict[str, Any]:
        counts = {split: sum(part.count for part in parts if part.split == split) for split in SPLITS}
        total = sum(counts.values())
        return {
            "codebase_version": "v3.0",
            "robot_type": "floating_gripper",
            "total_episodes": total,
            "total_frames": total * steps.length("push"),
            "total_tasks": 1,
            "chunks_size": FILES_PER_FOLDER,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": steps.FPS,
            "splits": {"train": f"0:{counts['train']}", "test": f"{counts['train']}:{total}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": None,
            "features": self.features(),
        }


def _feature(dtype: str, names: list[str] | None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [len(names) if names else 1], "names": names}
