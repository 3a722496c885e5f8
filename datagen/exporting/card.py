"""The card of an export, `README.md`: what it holds, in what units, under what licence, and how it was made."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Sequence
from typing import Any

from dipn_jax.commands import markdown
from dipn_jax.errors import UserError
from dipn_jax.storage import accounting, records
from dipn_jax.system import files, typed

from . import steps
from .columns import Column, of_episodes
from .source import SPLITS, Source

_KINDS = {
    "push": "pushes: a settled scene, one straight push, and every object's pose at each centimetre",
    "grasp": "grasps: a settled scene, one top-down grasp, and what it held",
    "images": "settled scenes, to which nothing is done",
}
_LAYOUTS = {
    "parquet": (
        "`data/SPLIT-NUMBER.parquet`, a row for each episode. An array is a list of fixed length in row-major order; "
        "the end of the column's name is its shape: `size_Nx3` becomes `[N, 3]` by `reshape(-1, 3)`."
    ),
    "npz": "`data/SPLIT-NUMBER.npz`; every array has its shape behind the axis of the episodes.",
    "hdf5": (
        "`data.hdf5` in robomimic's layout: `data/demo_EPISODE/obs/NAME`, `actions`, `rewards` and `dones` have a step "
        "along the first axis, `episode/NAME` is what the episode has once; `mask/train` and `mask/valid` (held out) "
        "name the episodes of each split. No environment of robomimic's can roll them out."
    ),
    "zarr": (
        "`SPLIT.zarr` (format 2), a replay buffer: `data/NAME` has the steps of all episodes one after another, "
        "`meta/episode_ends` says after how many steps each ends, `meta/NAME` is what an episode has once."
    ),
    "lerobot": (
        "LeRobot's format, version 3. A frame is a step: `observation.state` is the gripper, "
        "`observation.environment_state` the poses `[N, 7]` in row-major order, `observation.size` the sizes `[N, 3]` "
        "of the objects. There is no video: pictures are PNG; in `observation.images.height` grey is millimetres, in "
        "`observation.images.label` the slot plus one. Classes, masses, frictions, faults and the poses after the push "
        "are left out; the other formats have them."
    ),
}


def card(source: Source, form: str, images: str, command: Sequence[str]) -> str:
    """Return the card of an export as Markdown, with the head that Hugging Face reads.

    Args:
      source: the data set.
      form: of the export: parquet, npz, ...
      images: the value of `--images`.
      command: that made the export.
    """
    parts = [
        _head(form),
        f"# {len(source.episodes('train')) + len(source.episodes('test'))} {_KINDS[source.kind]}\n",
        "Simulated by dipn-jax in rigid-body physics. Lengths are metres, angles radians, masses kilograms. The frame "
        "of the workspace has its origin at the centre of the square of 0.448 m on the table, z up, angles from +x "
        "toward +y. Maps are indexed `[row, col]`, 2 mm a pixel, rows along +y and columns along +x.\n",
        f"## Files\n\n{_LAYOUTS[form]}\n",
        markdown.table(["split", "episodes"], [[split, str(len(source.episodes(split)))] for split in SPLITS]),
        "`test` is what `dipn-train` holds out of the same data set: about the last tenth, 1,000 at most. No scene is "
        "in both splits.\n",
        *_schema(source, form, images),
        "## Licence\n\nApache-2.0.\n",
        *_origin(source, command),
    ]
    return "\n".join(parts)


def _head(form: str) -> str:
    data = ""
    if form == "parquet":
        lines = [f"  - split: {split}\n    path: data/{split}-*.parquet\n" for split in SPLITS]
        data = "configs:\n- config_name: default\n  data_files:\n" + "".join(lines)
    elif form == "lerobot":
        data = "configs:\n- config_name: default\n  data_files: data/*/*.parquet\n"
    tags = ["robotics", "manipulation", "simulation", *(["LeRobot"] if form == "lerobot" else [])]
    named = "".join(f"- {tag}\n" for tag in tags)
    return f"---\nlicense: apache-2.0\ntask_categories:\n- robotics\ntags:\n{named}{data}---\n"


def _schema(source: Source, form: str, images: str) -> list[str]:
    """Return the tables of columns."""
    slots = f"N is {source.slots}, the number of object slots.\n"
    if form in ("parquet", "npz"):
        columns = of_episodes(source.kind, images)
        return ["## Columns\n", slots, _columns(columns, source.slots, flat=form == "parquet")]
    found = ["## A step\n", slots, _columns(steps.step_columns(source.kind, images), source.slots, flat=False)]
    if form != "lerobot":
        columns = steps.episode_columns(source.kind)
        found += ["## An episode\n", _columns(columns, source.slots, flat=False)]
    return found


def _columns(columns: Sequence[Column], slots: int, *, flat: bool) -> str:
    rows = [
        [f"`{c.flat_name if flat else c.name}`", c.dtype, str(list(c.lengths(slots))) if c.shape else "", c.meaning]
        for c in columns
    ]
    return markdown.table(["name", "type", "shape", "meaning"], rows)


def _origin(source: Source, command: Sequence[str]) -> list[str]:
    """Return how the data set and the export were made."""
    about = records.summary(source.folder)
    try:
        made = accounting.command(source.folder)
    except UserError:  # it says how the data set was made, and nothing of what is in it
        made = None
    said: dict[str, Any] = {
        "config": about["merged"] or about["config"],
        "made_by": about["made_by"],
        "faults": about["faults"],
    }
    return [
        "## How it was made\n",
        _fenced("bash", "\n".join(shlex.join(words) for words in (made, list(command)) if words)),
        f"The data set's fingerprint is `{source.fingerprint}`. Its configuration with the seed, who made it, and what "
        "was counted while it was made; `faults` counts scenes and actions that were dropped, too:\n",
        _fenced("json", json.dumps(said, indent=1)),
        _fenced("json", json.dumps({"exported_by": files.package_versions()}, indent=1)),
    ]


def _fenced(language: str, text: str) -> str:
    """Return a block of text that nothing in it can end."""
    lines = "\n".join(typed.one_line(line, most=10_000) for line in text.splitlines())
    longest = max((len(run) for run in re.findall("`+", lines)), default=0)
    fence = "`" * max(3, longest + 1)
    return f"{fence}{language}\n{lines}\n{fence}\n"
