import dataclasses
import json
import os
import pathlib
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.train import log
from dipn_jax.train.grasp import SHIFT_PIXELS, GraspTask, PretrainTask, view
from dipn_jax.train.loop import TrainConfig, fit, make_step
from dipn_jax.train.online import grasping as online
from dipn_jax.train.online import rounds
from dipn_jax.train.optimizers import make_optimizer
from dipn_jax.train.push import PushTask
from flax import nnx

from dipn_jax import geometry
from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.planning import candidates
from dipn_jax.sight import masks, render
from dipn_jax.storage import checkpoint, on_demand
from dipn_jax.world import scenes, shapes

SMALL = DipnConfig(width=8)
BRIEF = TrainConfig(steps=6, batch=4, eval_every=3, save_every=3)


@pytest.fixture(scope="module")
def task(data: dict[str, pathlib.Path]) -> PushTask:
    return PushTask(data["push"], SMALL, limit=None, centimetres=(5, 10))


def _weights(run: pathlib.Path) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(nnx.state(checkpoint.load_network(run, network="dipn")))]


@pytest.mark.slow
def test_a_folder_belongs_to_one_run(task: PushTask, tmp_path: pathlib.Path) -> None:
    fit(task, BRIEF, tmp_path)
    with pytest.raises(UserError, match="begun with batch=4, asked for batch=2"):
        fit(task, TrainConfig(steps=6, batch=2), tmp_path)


def test_a_run_that_is_going_on_is_not_started_again(
    task: PushTask, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def again(_: np.ndarray) -> Any:
        return fit(task, BRIEF, tmp_path)

    monkeypatch.setattr(task, "fetch", again)
    with pytest.raises(UserError, match=f"in use by host .*, pid {os.getpid()}, started"):
        fit(task, BRIEF, tmp_path)
    with pytest.raises(UserError, match="in use"), rounds.Run(tmp_path / "r", {}), rounds.Run(tmp_path / "r", {}):
        pass
    assert not (tmp_path / "owner.json").exists()


@pytest.mark.slow
def test_more_steps_go_on_where_the_rate_is_constant(task: PushTask, tmp_path: pathlib.Path) -> None:
    plan = dataclasses.replace(BRIEF, steps=2, optimizer="sgd", eval_every=2)
    more = dataclasses.replace(plan, steps=4)
    fit(task, plan, tmp_path / "on")
    fit(task, more, tmp_path / "on")
    fit(task, more, tmp_path / "whole")
    for a, b in zip(_weights(tmp_path / "whole"), _weights(tmp_path / "on"), strict=True):
        np.testing.assert_array_equal(a, b)


def _refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")


@pytest.mark.slow
def test_a_loss_that_is_not_finite_ends_a_run_at_the_last_finite_checkpoint(
    task: PushTask, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetched: list[np.ndarray] = []
    fetch = task.fetch

    def spoilt(index: np.ndarray) -> Any:
        fetched.append(index)
        batch = fetch(index)
        return batch.replace(target=batch.target * np.float32("nan")) if len(fetched) == 3 else batch

    monkeypatch.setattr(task, "fetch", spoilt)
    plan = TrainConfig(steps=8, batch=4, eval_every=2, save_every=2)
    with pytest.raises(UserError, match=r"^step 3: the loss is not finite at --learning-rate 0\.001, ex") as told:
        fit(task, plan, tmp_path)
    named = str(told.value).split("examples ")[1].split(";")[0]
    assert [int(n) for n in named.split()] == fetched[2].tolist()
    assert checkpoint.newest(tmp_path)[1]["step"] == 2  # type: ignore[index]
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] == ["00000002"]
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line, parse_constant=_refuse)["step"] for line in lines] == [2]


def test_weights_that_overflow_are_not_saved(task: PushTask, tmp_path: pathlib.Path) -> None:
    plan = TrainConfig(steps=1, batch=4, learning_rate=1e39, optimizer="sgd")
    with pytest.raises(UserError, match="step 1: a weight is not finite"):
        fit(task, plan, tmp_path)
    assert checkpoint.newest(tmp_path) is None and not (tmp_path / "metrics.jsonl").read_text()


def _loss(task: Any, model: nnx.Module, count: int) -> float:
    """Return the loss on the first `count` training examples."""
    graph, state = nnx.split(model)
    batch = task.fetch(np.arange(count))
    return float(jax.jit(lambda s: task.loss(nnx.merge(graph, s), batch, jax.random.key(5)))(state))


@pytest.mark.slow
def test_dipn_fits_its_training_data(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> None:
    """The loss on 22 pushes halves in 120 real steps."""
    task = PushTask(data["push"], SMALL, limit=None, centimetres=(10,))
    fit(task, TrainConfig(steps=120, batch=8, learning_rate=3e-3, eval_every=1000, save_every=1000), tmp_path)
    trained = checkpoint.load_network(tmp_path, network="dipn")
    assert _loss(task, trained, 16) < _loss(task, checkpoint.build("dipn", SMALL), 16) / 2


@pytest.mark.slow
def test_grasp_tasks_fit_their_training_data(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> None:
    """After pre-training on three scenes and training on 21 grasps each loss is below the entropy of its labels."""
    config = GraspConfig(width=8)
    pretrain = PretrainTask(data["images"], config)
    first = fit(
        pretrain, TrainConfig(steps=60, batch=3, learning_rate=5e-3, eval_every=60, save_every=60), tmp_path / "a"
    )
    assert first["held_out_loss"] < 0.5
    initial = checkpoint.load_network(tmp_path / "a", network="grasp")
    task = GraspTask((data["grasp"],), config)
    plan = TrainConfig(steps=120, batch=16, learning_rate=5e-3, eval_every=120, save_every=120)
    fit(task, plan, tmp_path / "b", initial=initial)
    rate = task.train_set.whole().success.mean()
    entropy = -(rate * np.log(rate) + (1 - rate) * np.log(1 - rate))
    loss = _loss(task, checkpoint.load_network(tmp_path / "b", network="grasp"), 20)
    assert loss < 0.7 * entropy  # a constant gets 1.0


@pytest.mark.slow
def test_learning_online_continues_where_it_was_stopped(engine: Any, tmp_path: pathlib.Path) -> None:
    plan = online.OnlineConfig(grasps=6, tables=2, updates=2, batch=4)
    network = GraspConfig(width=8, coarse=8, blocks=1)
    scene = scenes.fixed_count(3, spread=0.2)

    def learn(out: pathlib.Path) -> dict[str, float]:
        return online.learn(checkpoint.build("grasp", network), engine, scene, plan, out)

    whole = learn(tmp_path / "a")
    with pytest.MonkeyPatch.context() as patch:

        def stop(out: pathlib.Path, plan: online.OnlineConfig, state: online.State) -> None:
            if state.round == 2:
                raise KeyboardInterrupt

        patch.setattr(online, "_log", stop)
        with pytest.raises(KeyboardInterrupt):
            learn(tmp_path / "b")
    assert learn(tmp_path / "b") == whole == learn(tmp_path / "b")
    first, second = (checkpoint.load_network(tmp_path / name, network="grasp") for name in "ab")
    assert checkpoint.digest(first) == checkpoint.digest(second)
    assert checkpoint.digest(first) != checkpoint.digest(checkpoint.build("grasp", network))
    lines = [json.loads(line) for line in (tmp_path / "a" / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 4, 6]
    published = GraspConfig(preset="paper", stages=(1, 1, 1, 1))
    with pytest.raises(UserError, match="takes a compact network"):
        online.learn(checkpoint.build("grasp", published), engine, scene, plan, tmp_path / "c")


def test_data_sets_of_different_widths_are_joined(data: dict[str, pathlib.Path]) -> None:
    task = GraspTask((data["grasp"],), GraspConfig())
    learnt = task.train_set.whole()
    wide = on_demand.widened(learnt, 7)
    assert wide.scene.shape.shape[1] == 7 and (wide.scene.shape[:, 3:] == -1).all()
    for a, b in zip(task.prepare(wide).height, task.prepare(learnt).height, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_window_is_centred_on_the_executed_grasp(data: dict[str, pathlib.Path]) -> None:
    task = GraspTask((data["grasp"],), GraspConfig(width=8))
    episodes = task.train_set.take(np.arange(6))
    begin = jax.random.randint(jax.random.key(0), (6, 2), 0, 2 * SHIFT_PIXELS)
    images, pixel = view(task.fetch(np.arange(6)), begin)
    height = np.asarray(images)[np.arange(6), pixel[:, 0], pixel[:, 1], 3]
    _, row, col = candidates.grasp_index(episodes.grasp).T
    unturned = np.asarray(render.observe(episodes.scene, episodes.poses).height)[np.arange(6), row, col]
    assert np.median(np.abs(height - unturned)) < 1e-3  # equal up to a pixel of sampling


@pytest.mark.slow
def test_the_published_networks_take_a_training_step(data: dict[str, pathlib.Path]) -> None:
    """Traced, not compiled, with one block a stage; the networks themselves are trained in the tests of networks."""
    dipn, gn = (config(preset="paper", stages=(1, 1, 1, 1)) for config in (DipnConfig, GraspConfig))
    tasks = (
        PushTask(data["push"], dipn, limit=None, centimetres=(5, 10)),
        PretrainTask(data["images"], gn),
        GraspTask((data["grasp"],), gn),
    )
    optimizer = make_optimizer(BRIEF)
    for task in tasks:
        model = nnx.eval_shape(lambda task=task: checkpoint.build(task.network, task.network_config))
        graph, params, rest = nnx.split(model, nnx.Param, ...)  # type: ignore[misc]
        moments = jax.eval_shape(optimizer.init, params)
        step = make_step(task, graph, optimizer)
        after = jax.eval_shape(step, params, rest, moments, task.fetch(np.arange(2)), jax.random.key(0))
        assert after[3].shape == ()
        assert jax.tree.structure(after[:2]) == jax.tree.structure((params, rest))


def test_speed_and_memory_are_said_beside_the_losses(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(log.time, "monotonic", lambda: now)
    curve = log.Log(tmp_path, 0, batch=4)
    now += 50  # compiled
    curve.resume(1)
    now += 1
    curve.pause(6)
    now += 50  # saved
    curve.resume(6)
    now += 1
    curve.pause(10)
    now += 50  # evaluated
    curve.pause(10)
    said = curve.write(10, {"loss": 0.5})
    name, rate, other, memory = said.split()
    assert (name, rate, other) == ("examples_per_s", "18", "peak_memory_mb") and float(memory) > 100
    assert curve.write(10, {"loss": 0.5}).startswith("peak_memory_mb"), "nothing was timed since"
    curve.close()
    assert log.last(tmp_path) == {"step": 10, "loss": 0.5}
    assert log.Log(tmp_path / "other", 0, batch=4, writes=False).write(10, {"loss": 0.5}) == ""


@pytest.mark.slow
def test_a_hard_stop_inside_a_line_of_metrics_is_survived(task: PushTask, tmp_path: pathlib.Path) -> None:
    fit(task, BRIEF, tmp_path)
    whole = (tmp_path / "metrics.jsonl").read_text()
    (tmp_path / "metrics.jsonl").write_text(whole + '{"step": 7, "lo')
    fit(task, BRIEF, tmp_path)
    assert (tmp_path / "metrics.jsonl").read_text() == whole


def test_no_scene_is_on_both_sides_of_the_split(data: dict[str, pathlib.Path]) -> None:
    task = GraspTask((data["grasp"],), GraspConfig())
    seen = [{size.tobytes() for size in part.whole().scene.size} for part in (task.train_set, task.test_set)]
    assert not seen[0] & seen[1] and seen[1]


def test_an_example_is_the_rendered_scene_and_the_motion_of_the_push(task: PushTask) -> None:
    index = np.array([3, 0])
    kept, fresh = task.fetch(index), task.prepare(task.train_set.take(index))
    np.testing.assert_allclose(kept.inputs.crops, fresh.inputs.crops, atol=1e-3)  # kept in half precision
    np.testing.assert_array_equal(kept.target, fresh.target)
    episode = task.train_set.whole()[3]
    _, label = render.render_depth(episode.scene, episode.poses[0])
    centers, area = masks.mask_centers(label, task.slots)
    c, s = np.cos(episode.push.angle), np.sin(episode.push.angle)
    for k, centimetres in enumerate((5, 10)):
        motion = geometry.planar_motion(episode.poses[0], episode.poses[centimetres], centers)
        along = (motion[:, 0] * c + motion[:, 1] * s) / 0.002
        visible = np.asarray(area) > 0
        np.testing.assert_allclose(kept.target[0, visible, k, 0], along[visible], atol=1e-2)
    assert kept.taught.all()


def test_masks_found_in_the_image_give_the_same_targets_for_the_same_objects(
    task: PushTask, data: dict[str, pathlib.Path]
) -> None:
    found = PushTask(data["push"], SMALL, limit=None, centimetres=(5, 10), found=True)
    assert found.fingerprint != task.fingerprint
    index = np.arange(12)
    there, here = task.fetch(index), found.fetch(index)
    both = here.taught[..., 0] & there.inputs.present
    assert both.sum() > 0.9 * there.inputs.present.sum()  # two of one colour that touch are one mask
    apart = np.abs(here.target - there.target)[both]
    assert np.median(apart) < 0.1 and (apart > 5).mean() < 0.05
    assert np.abs(here.inputs.centers - there.inputs.centers)[both].max() < 0.05


def test_invalid_options_are_refused(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> None:
    with pytest.raises(UserError, match="--centimetres 0 5: want"):
        PushTask(data["push"], SMALL, limit=None, centimetres=(0, 5))
    with pytest.raises(UserError, match="--limit 1000"):
        PushTask(data["push"], SMALL, limit=1000, centimetres=(5,))
    with pytest.raises(UserError, match="leaves none of the pushes"):
        PushTask(data["push"], SMALL, limit=None, centimetres=(5,), without=shapes.CLASSES)
    with pytest.raises(UserError, match="holds push episodes, want grasp"):
        GraspTask((data["push"],), GraspConfig())
    task = PushTask(data["push"], SMALL, limit=None, centimetres=(5,))
    with pytest.raises(UserError, match="--optimizer"):
        fit(task, TrainConfig(steps=2, optimizer="adagrad"), tmp_path / "x")
    for change in ({"steps": 0}, {"eval_every": 0}, {"learning_rate": float("nan")}, {"seed": -1}):
        with pytest.raises(UserError, match=f"--{next(iter(change)).replace('_', '-')}"):
            fit(task, TrainConfig(**({"steps": 2} | change)), tmp_path / "y")
    assert not (tmp_path / "y").exists()
