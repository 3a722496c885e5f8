"""The program `dipn-train`: push, grasp-pretrain, grasp, grasp-online, baseline, sweep, export."""

from __future__ import annotations

import contextlib
import pathlib
import sys
import tempfile
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dipn_jax.commands import console
from dipn_jax.system.addresses import Place

from .configs import DEFAULT_COMPUTE, Compute, Preset, ShapeClass, TrainConfig, check
from .online.commands import baseline, grasp_online, say
from .sweep_command import sweep

if TYPE_CHECKING:
    from flax import nnx

    from dipn_jax.storage.space import Space

    from .loop import Task
    from .split import Folders

PUSH = TrainConfig(steps=1500, learning_rate=3e-3, eval_every=250, save_every=250)
"""Defaults of `dipn-train push`."""
GRASP_PRETRAIN = TrainConfig(steps=400, batch=8, learning_rate=2e-3, eval_every=100, save_every=100)
"""Defaults of `dipn-train grasp-pretrain`."""
GRASP = TrainConfig(steps=800, eval_every=250, save_every=250)
"""Defaults of `dipn-train grasp`."""


def _fit(
    task: Task, config: TrainConfig, out: pathlib.Path, compute: Compute, *, initial: nnx.Module | None = None
) -> None:
    from .loop import fit

    result = fit(task, config, out, initial=initial, compute=compute)
    if compute.check_only:
        console.say(f"{out}: nothing is wrong with options and data")
    else:
        say(out, result, digits=".4g")


def _begin(data: Folders, config: TrainConfig, out: pathlib.Path, compute: Compute) -> None:
    """Check the options, before any data is read, and join the other processes of the job, before JAX is used."""
    check(config, compute, out, data_sets=1 if isinstance(data, pathlib.Path) else len(data))
    if compute.data_parallel:
        from . import devices

        devices.join(compute)


@contextlib.contextmanager
def _space(out: pathlib.Path, compute: Compute) -> Iterator[Space]:
    """Yield where the data of a run is kept, with files in its folder, or in a temporary one if it is only compiled."""
    import jax

    from dipn_jax.storage.space import Space

    if compute.compile_only:
        with tempfile.TemporaryDirectory() as folder:
            yield Space(compute.memory, pathlib.Path(folder) / "examples")
    else:
        yield Space(compute.memory, out / "examples" / str(jax.process_index()))


def _local(data: Folders) -> tuple[pathlib.Path, ...]:
    """Return the folders of one data set or several: those given, and copies of what is at URLs."""
    from dipn_jax.storage import mirror

    return tuple(map(mirror.local, (data,) if isinstance(data, pathlib.Path) else data))


def _initial(init: pathlib.Path | None, network: str) -> Any:
    """Return the network to start from; None if none is given."""
    from dipn_jax.storage import checkpoint

    return checkpoint.load_network(init, network=network) if init else None


def push(
    data: tuple[Place, ...],
    out: pathlib.Path,
    init: pathlib.Path | None = None,
    preset: Preset = "compact",
    limit: int | None = None,
    centimetres: tuple[int, ...] = tuple(range(1, 11)),
    without: tuple[ShapeClass, ...] = (),
    masks: Literal["true", "found"] = "true",
    config: TrainConfig = PUSH,
    compute: Compute = DEFAULT_COMPUTE,
) -> None:
    r"""Train DIPN on push episodes; one network for every push distance.

    About four minutes on two cores:
      dipn-train push --data data/push --out runs/dipn

    As published (a GPU's work; 50 epochs of 1,500 pushes; when the rate falls is our reading of the released code):
      dipn-train push --data data/push --out runs/paper --preset paper --optimizer published \
        --learning-rate 1e-3 --batch 8 --weight-decay 2e-4 --limit 1500 --steps 9375 --centimetres 5

    Args:
      data: folders, or URLs, of push episodes; of each the last tenth is held out.
      out: run folder; the same command continues where it stopped.
      init: run to start from, or builtin; its architecture is used.
      preset: architecture, without --init.
      limit: learn from this many of the first episodes only; what is held out stays the same.
      centimetres: push distances that are learnt, whole centimetres from 1 to 10.
      without: leave out scenes with an object of these classes, to see how well unseen shapes are predicted.
      masks: true: the simulator's; found: cut out of the rendered image by colour and height.
      config: optimizer and schedule.
      compute: how steps are computed.
    """
    _begin(data, config, out, compute)
    from dipn_jax.networks.dipn import DipnConfig

    from .push import PushTask

    found, initial = masks == "found", _initial(init, "dipn")
    network = initial.config if initial else DipnConfig(preset=preset)
    with _space(out, compute) as space:
        task = PushTask(
            _local(data), network, limit=limit, centimetres=centimetres, without=without, found=found, space=space
        )
        with contextlib.closing(task):
            _fit(task, config, out, compute, initial=initial)


def grasp_pretrain(
    data: tuple[Place, ...],
    out: pathlib.Path,
    init: pathlib.Path | None = None,
    preset: Preset = "compact",
    config: TrainConfig = GRASP_PRETRAIN,
    compute: Compute = DEFAULT_COMPUTE,
) -> None:
    """Train GN on images alone: a pixel is positive where the fingers fit around something.

    About a minute on two cores:
      dipn-train grasp-pretrain --data data/images --out runs/gn-pretrained

    Args:
      data: folders, or URLs, of settled scenes (dipn-datagen images).
      out: run folder; the same command continues where it stopped.
      init: run to start from, or builtin; its architecture is used.
      preset: architecture, without --init.
      config: optimizer and schedule; an example is a view.
      compute: how steps are computed.
    """
    _begin(data, config, out, compute)
    from dipn_jax.networks.grasp import GraspConfig

    from .grasp import PretrainTask

    initial = _initial(init, "grasp")
    network = initial.config if initial else GraspConfig(preset=preset)
    with _space(out, compute) as space:
        _fit(PretrainTask(_local(data), network, space=space), config, out, compute, initial=initial)


def grasp(
    data: tuple[Place, ...],
    out: pathlib.Path,
    init: pathlib.Path | None = None,
    preset: Preset = "compact",
    limit: int | None = None,
    config: TrainConfig = GRASP,
    compute: Compute = DEFAULT_COMPUTE,
) -> None:
    """Train GN on the outcomes of executed grasps; the loss is at the executed pixel only.

    About three minutes on two cores:
      dipn-train grasp --data data/grasp --init runs/gn-pretrained --out runs/gn

    Args:
      data: folders, or URLs, of grasp episodes.
      out: run folder; the same command continues where it stopped.
      init: run to start from (grasp-pretrain's), or builtin; its architecture is used.
      preset: architecture, without --init.
      limit: learn from this many of the first grasps only; what is held out stays the same.
      config: optimizer and schedule; an example is a grasp.
      compute: how steps are computed.
    """
    _begin(data, config, out, compute)
    from dipn_jax.networks.grasp import GraspConfig

    from .grasp import GraspTask

    initial = _initial(init, "grasp")
    network = initial.config if initial else GraspConfig(preset=preset)
    with (
        _space(out, compute) as space,
        contextlib.closing(GraspTask(_local(data), network, limit=limit, space=space)) as task,
    ):
        _fit(task, config, out, compute, initial=initial)


def export(
    run: pathlib.Path,
    out: pathlib.Path,
    network: Literal["dipn", "grasp", "vpg"] = "dipn",
    format_: Annotated[Literal["run", "safetensors"], tyro.conf.arg(name="format")] = "run",
) -> None:
    """Export the weights of a run, without what only training needs.

    As a run to give to others, a quarter of its size, whose training cannot be continued:
      dipn-train export --run runs/dipn --out dipn_jax/data/dipn

    As a file for programs without JAX; its metadata say what the network takes and returns:
      dipn-train export --run builtin --network grasp --format safetensors --out gn.safetensors

    Args:
      run: run folder, or builtin.
      out: new run folder, or the file, NAME.safetensors.
      network: the kind of network in it; vpg for a run of baseline, whatever its method.
      format_: run, or safetensors.
    """
    from dipn_jax.storage import checkpoint, weights

    console.require_out(out if format_ == "run" else out.parent)
    if format_ == "run":
        checkpoint.export(run, out, network=network)
    else:
        weights.write(run, out, network=network)
    console.say(f"{out}: {network}")


COMMANDS = {
    "push": push,
    "grasp-pretrain": grasp_pretrain,
    "grasp": grasp,
    "grasp-online": grasp_online,
    "baseline": baseline,
    "sweep": sweep,
    "export": export,
}
"""The commands of `dipn-train`, by name."""


def main() -> None:
    """Run `dipn-train` and exit with its exit code."""
    sys.exit(console.run("Train the push and grasp networks; every run can be interrupted and resumed.", COMMANDS))


if __name__ == "__main__":
    main()
