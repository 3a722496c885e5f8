"""Read a step of a checkpoint: its metadata, the network's config in it, and stored arrays."""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from dipn_jax.errors import UserError
from dipn_jax.system import typed

FORM = {
    "format_version": int,
    "network": str,
    "network_config": dict,
    "step": typed.Whole(),
    "sha256": {str: str},
    "versions?": dict,
    "best?": {"step": typed.Whole(), "measure": str, "value": float},
}
"""Form of `meta.json`; `best` says at which step of the run so far a measure was lowest, that step included."""
MAX_CONFIG_NUMBER = 65_536
"""Largest number in a network's config."""


def config(cls: type, values: dict[str, Any]) -> Any:
    """Return a network's config dataclass, from its values in `meta.json`.

    Raises:
      TypeError: they do not fit it.
    """
    form = {f"{field.name}?": _form(field.default) for field in dataclasses.fields(cls)}
    unknown = sorted(set(values) - {field.name for field in dataclasses.fields(cls)})
    if unknown:
        raise TypeError(f"no option {typed.brief(unknown[0])}")
    try:
        typed.check(values, form)
        return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
    except (typed.Misfit, UserError) as error:
        raise TypeError(str(error)) from None


def _form(default: Any) -> typed.Form:
    """Return the `typed` form that values of this default's type must fit."""
    if isinstance(default, tuple):
        return [_form(default[0])]
    return typed.Whole(1, MAX_CONFIG_NUMBER) if type(default) is int else type(default)


_COUNTS_OF_LAYERS = ("stages", "blocks", "rounds")
"""Fields of configs that count layers, each of which has arrays of its own."""
_LAYERS = 32
"""Layers that are never too many; a preset does not use all fields, so a small network may have large ones."""


def require_room(part: pathlib.Path, config: Any) -> None:
    """Raise a UserError where a config is of a larger network than the stored arrays, before memory is taken for it.

    Args:
      part: folder of the network's arrays.
      config: its config; no number of layers in it is above the number of arrays, no size above the largest of theirs.
    """
    shapes = [one.shape for one in _stored(part).values()]
    largest = max([len(shapes), *(size for shape in shapes for size in shape)])
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        most = max(len(shapes), _LAYERS) if field.name in _COUNTS_OF_LAYERS else largest
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int) and number > most:
                raise UserError(f"checkpoint {part}: its config is of a larger network than its arrays; train again")


def single_process_options() -> ocp.options.MultiprocessingOptions:
    """Return Orbax's options for a process that reads or writes by itself, whatever the others of its job do."""
    me = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"process-{me}"
    )


def _reader() -> ocp.Checkpointer:
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=single_process_options())
    return ocp.Checkpointer(handler, multiprocessing_options=single_process_options())


def arrays(part: pathlib.Path) -> dict[str, np.ndarray]:
    """Return the arrays of one Orbax folder by their path in the tree, whatever devices saved them.

    Raises:
      UserError: they cannot be read.
    """
    as_numpy = {key: ocp.RestoreArgs(restore_type=np.ndarray) for key in _stored(part)}
    with _reading(part):
        restored: dict[str, np.ndarray] = _reader().restore(part, restore_args=as_numpy)
        return restored


def _stored(part: pathlib.Path) -> dict[str, Any]:
    """Return what Orbax says of the arrays of a folder, by their path in the tree."""
    with _reading(part):
        return dict(_reader().metadata(part).item_metadata.tree)


@contextlib.contextmanager
def _reading(part: pathlib.Path) -> Iterator[None]:
    """Turn any error while arrays are read into a UserError of one line: Orbax and TensorStore raise many kinds."""
    jax.devices()  # where there is none, the command says so; it is not the file's fault
    if not part.is_dir():
        exported = "dipn-train export writes none: start from it by --init, in another --out"
        advice = exported if part.name == "train" else "train again"
        raise UserError(f"checkpoint {part}: cannot be read (there is none); {advice}")
    try:
        yield
    except Exception as error:
        raise UserError(f"checkpoint {part}: cannot be read ({type(error).__name__}); train again") from None
