"""`dipn-train`: push, grasp-pretrain, grasp, grasp-online, baseline, export."""

from __future__ import annotations

import pathlib
import sys
from typing import Any, Literal

from dipn_jax import console
from dipn_jax.engine import EngineName
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.physics import make_engine
from dipn_jax.planning import scorers
from dipn_jax.storage import checkpoint
from dipn_jax.world import scenes

from . import baseline as baselines
from . import online
from .grasp import GraspTask, PretrainTask
from .loop import Task, TrainConfig, fit
from .push import PushTask

Preset = Literal["compact", "paper"]
ShapeClass = Literal["cuboid", "cylinder", "half_cylinder", "triangular_prism", "concave"]


def _fit(task: Task, config: TrainConfig, out: pathlib.Path, **options: Any) -> None:
    result = fit(task, config, out, **options)
    console.say(f"{out}: " + ", ".join(f"{name} {value:.4g}" for name, value in result.items()))


def push(
    data: pathlib.Path,
    out: pathlib.Path,
    preset: Preset = "compact",
    steps: int = 1500,
    batch: int = 32,
    learning_rate: float = 3e-3,
    weight_decay: float = 1e-4,
    optimizer: Literal["adamw", "sgd"] = "adamw",
    seed: int = 0,
    limit: int | None = None,
    centimetres: tuple[int, ...] = tuple(range(1, 11)),
    without: tuple[ShapeClass, ...] = (),
    masks: Literal["true", "found"] = "true",
    eval_every: int = 250,
    save_every: int = 250,
) -> None:
    """DIPN, from push episodes; one network for every push distance.

    About four minutes on two cores:
      dipn-train push --data data/push --out runs/dipn
    As published (a GPU's work; 50 epochs of 1,500 pushes):
      dipn-train push --data data/push --out runs/paper --preset paper --optimizer sgd --learning-rate 1e-3
      --batch 8 --weight-decay 2e-4 --limit 1500 --steps 9375 --centimetres 5

    Args:
      data: folder of push episodes.
      out: run folder; the same command goes on where it stopped.
      preset: architecture.
      steps: optimizer steps.
      batch: examples a step.
      learning_rate: at its highest.
      weight_decay: decay.
      optimizer: adamw with cosine decay, or sgd with momentum 0.9.
      seed: seed of weights, order and augmentation.
      limit: learn from the first so many episodes only; what is held out stays the same.
      centimetres: push distances learnt.
      without: leave out scenes with an object of these classes, to see how well they are guessed.
      masks: true: the simulator's; found: cut out of the rendered image by colour and height.
      eval_every: steps between points of the learning curve.
      save_every: steps between checkpoints.
    """
    config = TrainConfig(steps, batch, learning_rate, weight_decay, optimizer, seed, eval_every, save_every)
    network = DipnConfig(preset=preset)
    found = masks == "found"
    task = PushTask(data, network, limit=limit, centimetres=centimetres, without=without, found=found)
    _fit(task, config, out)


def grasp_pretrain(
    data: pathlib.Path,
    out: pathlib.Path,
    preset: Preset = "compact",
    steps: int = 400,
    batch: int = 8,
    learning_rate: float = 2e-3,
    weight_decay: float = 1e-4,
    seed: int = 0,
    eval_every: int = 100,
    save_every: int = 100,
) -> None:
    """GN on images alone: a pixel is positive where the fingers fit around something.

    About a minute on two cores:
      dipn-train grasp-pretrain --data data/images --out runs/gn-pretrained

    Args:
      data: folder of settled scenes (dipn-datagen images).
      out: run folder; the same command goes on where it stopped.
      preset: architecture.
      steps: optimizer steps.
      batch: views a step.
      learning_rate: at its highest.
      weight_decay: decay.
      seed: seed of weights, order and views.
      eval_every: steps between points of the learning curve.
      save_every: steps between checkpoints.
    """
    config = TrainConfig(steps, batch, learning_rate, weight_decay, "adamw", seed, eval_every, save_every)
    _fit(PretrainTask(data, GraspConfig(preset=preset)), config, out)


def grasp(
    data: tuple[pathlib.Path, ...],
    out: pathlib.Path,
    init: pathlib.Path | None = None,
    preset: Preset = "compact",
    steps: int = 800,
    batch: int = 32,
    learning_rate: float = 1e-3,
    weight_decay: float = 1e-4,
    seed: int = 0,
    eval_every: int = 250,
    save_every: int = 250,
) -> None:
    """GN on the outcomes of executed grasps, loss at the executed pixel only.

    About three minutes on two cores:
      dipn-train grasp --data data/grasp --init runs/gn-pretrained --out runs/gn

    Args:
      data: folders of grasp episodes.
      out: run folder; the same command goes on where it stopped.
      init: run to start from (grasp-pretrain's); its architecture is used.
      preset: architecture, without --init.
      steps: optimizer steps.
      batch: grasps a step.
      learning_rate: at its highest.
      weight_decay: decay.
      seed: seed of weights, order and augmentation.
      eval_every: steps between points of the learning curve.
      save_every: steps between checkpoints.
    """
    config = TrainConfig(steps, batch, learning_rate, weight_decay, "adamw", seed, eval_every, save_every)
    initial: Any = checkpoint.load_network(init, network="grasp") if init else None
    network_config = initial.config if initial else GraspConfig(preset=preset)
    _fit(GraspTask(data, network_config), config, out, initial=initial)


def grasp_online(
    out: pathlib.Path,
    init: pathlib.Path | None = None,
    grasps: int = 300,
    objects: str = "10",
    tables: int = 10,
    updates: int = 20,
    batch: int = 32,
    learning_rate: float = 5e-4,
    weight_decay: float = 1e-4,
    seed: int = 0,
    engine: EngineName = "auto",
) -> None:
    """GN learns while it grasps: the best grasp on each of several tables, then some steps on all outcomes so far.

    Two minutes on two cores:
      dipn-train grasp-online --init runs/gn-pretrained --out runs/gn-online

    Args:
      out: run folder; the same command goes on where it stopped.
      init: run to start from (grasp-pretrain's); without it the compact network knows nothing.
      grasps: how many.
      objects: number of objects on a fresh table: 10, or 1:7.
      tables: grasped from side by side.
      updates: optimizer steps after a grasp on each table.
      batch: outcomes a step.
      learning_rate: constant.
      weight_decay: decay.
      seed: seed of scenes, weights, order and augmentation.
      engine: physics.
    """
    console.require_positive(grasps=grasps, tables=tables, updates=updates, batch=batch, learning_rate=learning_rate)
    console.require_between(0, 1, weight_decay=weight_decay)
    console.require_seed(seed)
    console.require_out(out)
    config = online.OnlineConfig(grasps, tables, updates, batch, learning_rate, weight_decay, seed, init is not None)
    model: Any
    if init:
        model = checkpoint.load_network(init, network="grasp")
    else:
        model = checkpoint.build("grasp", GraspConfig(), seed=seed)
    scene_config = scenes.parse_objects(objects)
    result = online.learn(model, model.config, make_engine(engine), scene_config, config, out)
    console.say(f"{out}: " + ", ".join(f"{name} {value:.3f}" for name, value in result.items()))


def baseline(
    out: pathlib.Path,
    method: baselines.MethodName = "vpg",
    grasp_net: pathlib.Path | None = None,
    preset: Preset = "compact",
    actions: int = 2500,
    objects: str = "10",
    tables: int = 10,
    updates: int = 10,
    batch: int = 32,
    learning_rate: float = 5e-4,
    weight_decay: float = 1e-4,
    seed: int = 0,
    engine: EngineName = "auto",
) -> None:
    """A compared method learns while it acts: VPG, the grasps of its reactive form (REA), or DQN's pushes beside GN.

    With the samples that the paper gives them, 10 to 25 minutes each on two cores:
      dipn-train baseline --method vpg --actions 2500 --out runs/vpg
      dipn-train baseline --method rea --actions 1500 --out runs/rea
      dipn-train baseline --method dqn --actions 1500 --grasp-net runs/gn --out runs/dqn

    Args:
      out: run folder; the same command goes on where it stopped.
      method: vpg, rea or dqn.
      grasp_net: run of dipn-train grasp or grasp-online, or builtin, whose grasps dqn takes.
      preset: architecture; paper is two DenseNet-121 trunks a primitive, for an accelerator.
      actions: pushes and grasps in all.
      objects: number of objects on a fresh table: 10, or 1:7.
      tables: acted on side by side.
      updates: optimizer steps after an action on each table.
      batch: outcomes a step, of pushes and of grasps each.
      learning_rate: constant.
      weight_decay: decay.
      seed: seed of scenes, weights, order and exploration.
      engine: physics.
    """
    console.require_positive(actions=actions, tables=tables, updates=updates, batch=batch, learning_rate=learning_rate)
    console.require_between(0, 1, weight_decay=weight_decay)
    console.require_seed(seed)
    console.require_out(out)
    learning = (tables, updates, batch, learning_rate, weight_decay, seed)
    config = baselines.BaselineConfig(method, preset, actions, *learning)
    gn: Any = checkpoint.load_network(grasp_net, network="grasp") if grasp_net else None
    scored: dict[str, Any] = {"scorer": scorers.cautious_scorer(gn), "scored_by": checkpoint.digest(gn)} if gn else {}
    result = baselines.learn(make_engine(engine), scenes.parse_objects(objects), config, out, **scored)
    console.say(f"{out}: " + ", ".join(f"{name} {value:.3f}" for name, value in result.items()))


def export(
    run: pathlib.Path,
    out: pathlib.Path,
    network: Literal["dipn", "grasp"] = "dipn",
) -> None:
    """The weights of a run alone, a quarter of its size: a run that can be given to others, not gone on with.

      dipn-train export --run runs/dipn --out dipn_jax/data/dipn

    Args:
      run: run folder.
      out: new run folder.
      network: what is in it.
    """
    console.require_out(out)
    checkpoint.export(run, out, network=network)
    console.say(f"{out}: {network}")


COMMANDS = {
    "push": push,
    "grasp-pretrain": grasp_pretrain,
    "grasp": grasp,
    "grasp-online": grasp_online,
    "baseline": baseline,
    "export": export,
}


def main() -> None:
    """Entry point."""
    sys.exit(console.run("Train the push and grasp networks; every run can be interrupted and resumed.", COMMANDS))


if __name__ == "__main__":
    main()
