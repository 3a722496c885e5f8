"""The program `dipn-train`: push, grasp-pretrain, grasp, grasp-online, baseline, export."""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dipn_jax import console
from dipn_jax.names import EngineName

from .configs import BaselineConfig, OnlineConfig, Preset, ShapeClass, TrainConfig

if TYPE_CHECKING:
    from flax import nnx

    from .loop import Task

PUSH = TrainConfig(steps=1500, learning_rate=3e-3, eval_every=250, save_every=250)
"""How `push` trains unless told otherwise."""
GRASP_PRETRAIN = TrainConfig(steps=400, batch=8, learning_rate=2e-3, eval_every=100, save_every=100)
"""How `grasp-pretrain` trains unless told otherwise."""
GRASP = TrainConfig(steps=800, eval_every=250, save_every=250)
"""How `grasp` trains unless told otherwise."""
GRASP_ONLINE = OnlineConfig()
"""How `grasp-online` learns unless told otherwise."""
BASELINE = BaselineConfig()
"""How `baseline` learns unless told otherwise."""


def _fit(task: Task, config: TrainConfig, out: pathlib.Path, *, initial: nnx.Module | None = None) -> None:
    from .loop import fit

    _say(out, fit(task, config, out, initial=initial), digits=".4g")


def _initial(init: pathlib.Path | None, network: str) -> Any:
    """The network to start from, if one is given."""
    from dipn_jax.storage import checkpoint

    return checkpoint.load_network(init, network=network) if init else None


def _say(out: pathlib.Path, result: dict[str, float], *, digits: str) -> None:
    console.say(f"{out}: " + ", ".join(f"{name} {value:{digits}}" for name, value in result.items()))


def push(
    data: pathlib.Path,
    out: pathlib.Path,
    init: pathlib.Path | None = None,
    preset: Preset = "compact",
    limit: int | None = None,
    centimetres: tuple[int, ...] = tuple(range(1, 11)),
    without: tuple[ShapeClass, ...] = (),
    masks: Literal["true", "found"] = "true",
    config: TrainConfig = PUSH,
) -> None:
    """Train DIPN on push episodes; one network for every push distance.

    About four minutes on two cores:
      dipn-train push --data data/push --out runs/dipn

    As published (a GPU's work; 50 epochs of 1,500 pushes; when the rate falls is our reading of the released code):
      dipn-train push --data data/push --out runs/paper --preset paper --optimizer published --learning-rate 1e-3 \
        --batch 8 --weight-decay 2e-4 --limit 1500 --steps 9375 --centimetres 5

    Args:
      data: folder of push episodes.
      out: run folder; the same command continues where it stopped.
      init: run to start from, or builtin; its architecture is used.
      preset: architecture, without --init.
      limit: learn from this many of the first episodes only; what is held out stays the same.
      centimetres: push distances learnt.
      without: leave out scenes with an object of these classes, to see how well unseen shapes are predicted.
      masks: true: the simulator's; found: cut out of the rendered image by colour and height.
      config: optimizer and schedule.
    """
    from dipn_jax.networks.dipn import DipnConfig

    from .push import PushTask

    found, initial = masks == "found", _initial(init, "dipn")
    network = initial.config if initial else DipnConfig(preset=preset)
    task = PushTask(data, network, limit=limit, centimetres=centimetres, without=without, found=found)
    _fit(task, config, out, initial=initial)


def grasp_pretrain(
    data: pathlib.Path,
    out: pathlib.Path,
    init: pathlib.Path | None = None,
    preset: Preset = "compact",
    config: TrainConfig = GRASP_PRETRAIN,
) -> None:
    """Train GN on images alone: a pixel is positive where the fingers fit around something.

    About a minute on two cores:
      dipn-train grasp-pretrain --data data/images --out runs/gn-pretrained

    Args:
      data: folder of settled scenes (dipn-datagen images).
      out: run folder; the same command continues where it stopped.
      init: run to start from, or builtin; its architecture is used.
      preset: architecture, without --init.
      config: optimizer and schedule; an example is a view.
    """
    from dipn_jax.networks.grasp import GraspConfig

    from .grasp import PretrainTask

    initial = _initial(init, "grasp")
    network = initial.config if initial else GraspConfig(preset=preset)
    _fit(PretrainTask(data, network), config, out, initial=initial)


def grasp(
    data: tuple[pathlib.Path, ...],
    out: pathlib.Path,
    init: pathlib.Path | None = None,
    preset: Preset = "compact",
    config: TrainConfig = GRASP,
) -> None:
    """Train GN on the outcomes of executed grasps; the loss is at the executed pixel only.

    About three minutes on two cores:
      dipn-train grasp --data data/grasp --init runs/gn-pretrained --out runs/gn

    Args:
      data: folders of grasp episodes.
      out: run folder; the same command continues where it stopped.
      init: run to start from (grasp-pretrain's), or builtin; its architecture is used.
      preset: architecture, without --init.
      config: optimizer and schedule; an example is a grasp.
    """
    from dipn_jax.networks.grasp import GraspConfig

    from .grasp import GraspTask

    initial = _initial(init, "grasp")
    network = initial.config if initial else GraspConfig(preset=preset)
    _fit(GraspTask(data, network), config, out, initial=initial)


def grasp_online(
    out: pathlib.Path,
    init: pathlib.Path | None = None,
    objects: str = "10",
    engine: EngineName = "auto",
    threads: int | None = None,
    config: OnlineConfig = GRASP_ONLINE,
) -> None:
    """Train GN while it grasps: the best grasp on each of several tables, then some steps on all outcomes so far.

    Two minutes on two cores:
      dipn-train grasp-online --init runs/gn-pretrained --out runs/gn-online

    Args:
      out: run folder; the same command continues where it stopped.
      init: run to start from (grasp-pretrain's), or builtin; without it the compact network has random weights.
      objects: number of objects on a fresh table: 10, or 1:7.
      engine: physics engine.
      threads: that native simulates on; one a core if not given.
      config: amount and schedule of learning.
    """
    console.require_positive(grasps=config.grasps)
    _check(out, config)
    from dipn_jax.networks.grasp import GraspConfig
    from dipn_jax.physics import make_engine
    from dipn_jax.storage import checkpoint
    from dipn_jax.world import scenes

    from . import online

    model: Any
    if init:
        model = checkpoint.load_network(init, network="grasp")
    else:
        model = checkpoint.build("grasp", GraspConfig(), seed=config.seed)
    config = dataclasses.replace(config, pretrained=init is not None)
    result = online.learn(model, make_engine(engine, threads=threads), scenes.parse_objects(objects), config, out)
    _say(out, result, digits=".3f")


def baseline(
    out: pathlib.Path,
    grasp_net: pathlib.Path | None = None,
    objects: str = "10",
    engine: EngineName = "auto",
    threads: int | None = None,
    config: BaselineConfig = BASELINE,
) -> None:
    """Train a compared method while it acts: VPG, the grasps of its reactive form (REA), or DQN's pushes beside GN.

    Only vpg and dqn explore, by drawing push or grasp at random. With the samples that the paper gives them, 10 to 40
    minutes each on two cores:
      dipn-train baseline --method vpg --actions 2500 --out runs/vpg
      dipn-train baseline --method rea --actions 1500 --out runs/rea
      dipn-train baseline --method dqn --actions 1500 --grasp-net runs/gn --out runs/dqn

    Args:
      out: run folder; the same command continues where it stopped.
      grasp_net: run of dipn-train grasp or grasp-online, or builtin, whose grasps dqn takes.
      objects: number of objects on a fresh table: 10, or 1:7.
      engine: physics engine.
      threads: that native simulates on; one a core if not given.
      config: method, and amount and schedule of learning.
    """
    console.require_positive(actions=config.actions)
    _check(out, config)
    from dipn_jax.physics import make_engine
    from dipn_jax.planning import scorers
    from dipn_jax.storage import checkpoint
    from dipn_jax.world import scenes

    from . import baseline as baselines

    gn: Any = checkpoint.load_network(grasp_net, network="grasp") if grasp_net else None
    result = baselines.learn(
        make_engine(engine, threads=threads),
        scenes.parse_objects(objects),
        config,
        out,
        scorer=scorers.aided_scorer(gn) if gn else None,
        scored_by=checkpoint.digest(gn) if gn else "",
    )
    _say(out, result, digits=".3f")


def _check(out: pathlib.Path, config: OnlineConfig | BaselineConfig) -> None:
    """Raise a UserError for options of learning while acting that make no sense, or an unusable `out`."""
    console.require_positive(tables=config.tables, updates=config.updates, batch=config.batch)
    console.require_positive(learning_rate=config.learning_rate)
    console.require_between(0, 1, weight_decay=config.weight_decay)
    console.require_seed(config.seed)
    console.require_out(out)


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
      out: new run folder, or the file.
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
    "export": export,
}
"""The commands of `dipn-train`, by name."""


def main() -> None:
    """Run `dipn-train` and exit with its exit code."""
    sys.exit(console.run("Train the push and grasp networks; every run can be interrupted and resumed.", COMMANDS))


if __name__ == "__main__":
    main()
