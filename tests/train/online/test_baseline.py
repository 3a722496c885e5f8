"""The compared methods: rewards, targets, tables, training, and interruptions of it."""

import dataclasses
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dipn_jax.train.grasp import SHIFT_PIXELS, WINDOW_PIXELS, Window, windows
from dipn_jax.train.online import acting, baseline, tables
from dipn_jax.train.online.acting import Look

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.planning import scorers
from dipn_jax.seeds import Purpose
from dipn_jax.storage import checkpoint, resume
from dipn_jax.structs import Grasp, Push
from dipn_jax.world import scenes

CONFIG = scenes.fixed_count(3, spread=0.2)


def _look(height: np.ndarray, grasp_value: float) -> Look:
    count = len(height)
    push = Push(np.zeros((count, 2)), np.zeros(count), np.zeros(count))
    grasp = Grasp(np.zeros((count, 2)), np.zeros(count), np.zeros(count))
    values = np.full(count, grasp_value)
    return Look(height, push, values, grasp, values)


def _heights(*pixels: int) -> np.ndarray:
    """Return maps with the given numbers of pixels of an object."""
    maps = np.zeros((len(pixels), 224 * 224))
    for row, count in zip(maps, pixels, strict=True):
        row[:count] = 0.05
    return maps.reshape(-1, 224, 224)


def test_a_push_is_rewarded_for_change() -> None:
    now, then = _look(_heights(1000, 1000), 0.5), _look(_heights(1299, 1301), 0.5)
    np.testing.assert_array_equal(acting.push_reward(now, then, method="vpg"), [0.0, 0.5])


def test_dqns_push_is_rewarded_for_a_better_grasp_and_for_uncovering() -> None:
    now = _look(_heights(1000, 1000, 1000, 1000), 0.5)
    then = _look(_heights(1000, 1000, 1400, 600), 0.8)
    then.height[1] = np.roll(then.height[1], 1000)
    reward = acting.push_reward(now, then, method="dqn")
    np.testing.assert_allclose(reward, [0.0, 0.65, 0.8, 0.0])  # unchanged, moved, uncovered, covered
    same = _look(then.height, 0.54)
    np.testing.assert_allclose(acting.push_reward(now, same, method="dqn"), [0.0, 0.0, 0.8, 0.0])


def test_a_target_has_the_value_of_the_best_next_action_but_no_impossible_one() -> None:
    then = _look(_heights(*[1000] * 4), 0.8)
    then = then.replace(push_value=np.array([0.6, 1.2, 5.0, 1.0]))
    target = acting.q_targets(np.array([1.0, 0.5, 0.5, 0.0]), then, np.array([True, True, True, False]))
    np.testing.assert_allclose(target, [1.4, 1.1, 1.5, 0.0])


def test_finished_tables_are_set_anew(engine: Any) -> None:
    played = tables.begin(engine, CONFIG, count=4, seed=0, purpose=Purpose.BASELINE_TABLES)
    scene, poses = jax.tree.map(np.array, played.scene), played.poses.copy()
    scene.shape[0] = -1  # cleared
    poses[1, 0, 0] = 0.3  # spilt
    none, good = np.zeros(4, bool), np.array([True, True, False, True])
    assert played.step(scene, poses, none, good, engine, CONFIG).tolist() == [True, True, True, False]
    assert (played.scene.shape >= 0).all() and (np.abs(played.poses[..., :2]) < 0.224).all()
    np.testing.assert_array_equal(played.poses[3], poses[3])
    for stuck in (False, True):  # the last table was idle once before
        again = played.step(played.scene, played.poses, none, np.ones(4, bool), engine, CONFIG)
        assert again[3] == stuck


def _tables(count: int, push_value: float) -> Look:
    """Return tables whose pushes have this value, and whose grasps are worth 0.5."""
    return _look(np.zeros((count, 1, 1)), 0.5).replace(push_value=np.full(count, push_value))


def test_exploration_draws_the_primitive_in_equal_shares_and_fades() -> None:
    """Half of the explored actions are what they would have been anyway: 0.5 / 2 then 0.1 / 2 differ."""
    for better, share in ((1.0, 1.0), (0.0, 0.0)):
        for actions, other in ((0, 0.25), (100_000, 0.05)):
            pushing = acting.choose(_tables(4000, better), np.random.default_rng(0), actions, may_push=True)
            assert pushing.mean() == pytest.approx(abs(share - other), abs=0.02)


def test_nothing_is_pushed_where_no_push_can_be_begun_or_only_grasps_are_learnt() -> None:
    for value, may_push in ((-np.inf, True), (1.0, False)):
        assert not acting.choose(_tables(4000, value), np.random.default_rng(0), 0, may_push=may_push).any()


@pytest.mark.parametrize("method", ["vpg", "rea", "dqn"])
def test_an_explored_action_is_the_best_one_of_its_primitive(
    method: Any, engine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every action is explored, and only the push or grasp with the highest value is executed."""
    monkeypatch.setattr(acting, "EXPLORED_AT_LEAST", 1.0)
    count, did = 40, {}
    best = _tables(count, 1.0)
    best = best.replace(push=best.push.replace(angle=np.linspace(0, 1, count)))
    best = best.replace(grasp=best.grasp.replace(angle=np.linspace(2, 3, count)))

    def execute(_: Any, scene: Any, poses: Any, pushing: Any, push: Push, grasp: Grasp) -> Any:
        did.update(pushing=pushing, push=push.angle, grasp=grasp.angle)
        return scene, poses, np.zeros((count, 3), bool), np.ones(count, bool)

    monkeypatch.setattr(acting, "execute", execute)
    begun = tables.begin(engine, CONFIG, count=2, seed=0, purpose=Purpose.BASELINE_TABLES)
    many = dataclasses.replace(begun, scene=structs.take(begun.scene, np.zeros(count, int)), idle=np.zeros(count, int))
    many.poses = np.repeat(begun.poses[:1], count, 0)
    state = baseline.State(None, None, None, many)
    config = baseline.BaselineConfig(method, tables=count)
    baseline._act(state, lambda *_: best, engine, CONFIG, config)
    pushes = did["pushing"].sum()
    assert pushes == 0 if method == "rea" else 10 < pushes < 30
    np.testing.assert_array_equal(did["push"], best.push.angle)
    np.testing.assert_array_equal(did["grasp"], best.grasp.angle)
    learnt = {name: sum(len(some.target) for some in state.seen[name]) for name in ("push", "grasp")}
    assert learnt == {"push": pushes, "grasp": 0 if method == "dqn" else count - pushes}


class _Recorder:
    """A network whose maps are the heights; it keeps the images that it was shown."""

    def __init__(self) -> None:
        self.shown: dict[str, np.ndarray] = {}

    def push(self, images: jax.Array) -> jax.Array:
        self.shown["push"] = np.asarray(images)
        return images[..., 3]

    def grasp(self, images: jax.Array) -> jax.Array:
        self.shown["grasp"] = np.asarray(images)
        return images[..., 3]


def test_outcomes_are_learnt_from_mirror_images_in_new_colours_and_pushes_are_never_turned_round() -> None:
    """Heights rise along rows and along columns, so the slopes show whether an image was mirrored."""
    count, wide = 64, 32
    rise = np.arange(wide)[:, None] / 64 + np.arange(wide) / 1024
    some = Window(
        np.broadcast_to(rise, (count, wide, wide)).astype(np.float16),
        np.zeros((count, wide, wide), np.int8),
        np.zeros((count, 1, 3), np.float32),
        np.linspace(-3, 3, count).astype(np.float32),
    )
    network: Any = _Recorder()
    outcomes = baseline._Outcomes("value")
    loss = outcomes.loss(network, {"push": some, "grasp": some}, jax.random.key(0))
    error = np.abs(rise[wide // 2, wide // 2] - np.asarray(some.target))
    each = np.where(error < 1, 0.5 * error**2, error - 0.5).mean()
    np.testing.assert_allclose(loss, 2 * each, rtol=1e-6)  # at the executed pixel, wherever that went
    for name, turned in (("push", False), ("grasp", True)):
        images = network.shown[name]
        rows, cols = (np.diff(images[..., 3], axis=axis)[:, 0, 0] > 0 for axis in (1, 2))
        assert 0.2 < rows.mean() < 0.8 and (0.2 < cols.mean() < 0.8 if turned else cols.all()), name
        assert len(np.unique(images[:, 0, 0, :3], axis=0)) > 5, "objects keep their colours"
        assert len(np.unique(images[cols & rows][:, 0, 0, 3])) > 3, "images are not shifted"


def _flat_scores(images: jax.Array) -> jax.Array:
    """Return scores like those of a GN that prefers higher objects."""
    return jnp.tile(images[:, None, ..., 3], (1, 16, 1, 1))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["vpg", "rea", "dqn"])
def test_an_interrupted_run_continues_to_the_same_end(
    method: Any, engine: Any, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = baseline.BaselineConfig(method, actions=8, tables=4, updates=2, batch=4)
    gn: dict[str, Any] = {"scorer": _flat_scores, "scored_by": "one"} if method == "dqn" else {}
    futures: list[int] = []
    q_targets = acting.q_targets
    monkeypatch.setattr(acting, "q_targets", lambda *args: futures.append(1) or q_targets(*args))
    whole = baseline.learn(engine, CONFIG, config, tmp_path / "a", **gn)
    assert bool(futures) == (method != "rea"), "values count what comes next, chances do not"
    save = resume.Partial.save

    def stop(self: resume.Partial, state: Any) -> None:
        save(self, state)
        raise KeyboardInterrupt

    monkeypatch.setattr(resume.Partial, "save", stop)
    with pytest.raises(KeyboardInterrupt):
        baseline.learn(engine, CONFIG, config, tmp_path / "b", **gn)
    monkeypatch.setattr(resume.Partial, "save", save)
    if method == "dqn":
        with pytest.raises(UserError, match="grasp_net"):
            baseline.learn(engine, CONFIG, config, tmp_path / "b", scorer=_flat_scores, scored_by="another")
    assert baseline.learn(engine, CONFIG, config, tmp_path / "b", **gn) == whole
    there, here = (checkpoint.load_network(tmp_path / name, network="vpg") for name in "ab")
    assert checkpoint.digest(there) == checkpoint.digest(here)
    pushes, grasps = scorers.load_values(tmp_path / "a")
    assert (pushes is None) == (method == "rea") and (grasps is None) == (method == "dqn")
    with pytest.raises(UserError, match="takes a --grasp-net" if gn else "takes no --grasp-net"):
        baseline.learn(engine, CONFIG, config, tmp_path / "c", **({} if gn else {"scorer": grasps}))
    with pytest.raises(UserError, match="seed"):
        other = baseline.BaselineConfig(method, actions=8, tables=4, updates=2, batch=4, seed=1)
        baseline.learn(engine, CONFIG, other, tmp_path / "a", **gn)


@pytest.mark.slow
def test_the_published_form_takes_a_training_step(engine: Any) -> None:
    """It is traced, not compiled."""
    import functools

    import optax
    from dipn_jax.train.loop import make_step
    from flax import nnx

    from dipn_jax.networks.vpg import VpgConfig

    model = checkpoint.build("vpg", VpgConfig("paper", blocks=(1, 1, 1, 1)))
    graph, params, rest = nnx.split(model, nnx.Param, ...)  # type: ignore[misc]
    played = tables.begin(engine, CONFIG, count=2, seed=1, purpose=Purpose.BASELINE_TABLES)
    look = functools.partial(acting.look, graph, scorer=None, distance=0.1)
    seen = jax.eval_shape(look, params, rest, played.scene, played.poses, np.ones(2, bool))
    assert seen.push_value.shape == seen.grasp_value.shape == (2,)
    wide = WINDOW_PIXELS["paper"] + 2 * SHIFT_PIXELS
    some = Window(
        np.zeros((2, wide, wide), np.float16), np.zeros((2, wide, wide), np.int8), np.zeros((2, 3, 3)), np.zeros(2)
    )
    optimizer = optax.adam(1e-3)
    step = make_step(baseline._Outcomes("value"), graph, optimizer)
    moments = jax.eval_shape(optimizer.init, params)
    after = jax.eval_shape(step, params, rest, moments, {"push": some, "grasp": some}, jax.random.key(0))
    assert after[3].shape == () and jax.tree.leaves(after[1]), "no batch statistics"


def test_values_are_learnt_at_the_executed_pixel(engine: Any) -> None:
    """A network fits two outcomes that differ only in the executed pixel."""
    import optax
    from dipn_jax.train.loop import make_step
    from flax import nnx

    from dipn_jax.networks.vpg import VpgConfig
    from dipn_jax.structs import GraspEpisode

    played = tables.begin(engine, CONFIG, count=2, seed=1, purpose=Purpose.BASELINE_TABLES)
    center = played.poses[:, 0, :2]
    aim = Grasp(np.stack([center[0], center[0] + [0.0, 0.06]]), np.zeros(2), np.zeros(2))
    first = structs.take(played.scene, np.zeros(2, int)), played.poses[np.zeros(2, int)]
    held = np.zeros((2, 3), bool)
    target = np.array([1.0, 0.0], np.float32)
    batch = windows(
        GraspEpisode(first[0], first[1], first[1], aim, held, held.any(1), np.zeros(2, int)),
        pixels=WINDOW_PIXELS["compact"] + 2 * SHIFT_PIXELS,
    ).replace(target=target)
    batch = structs.take(batch, np.arange(32) % 2)  # each is moved by some pixels of its own
    model = checkpoint.build("vpg", VpgConfig(parts=("grasp",), width=8, coarse=8))
    graph, params, rest = nnx.split(model, nnx.Param, ...)  # type: ignore[misc]
    optimizer = optax.adam(2e-3)
    step = make_step(baseline._Outcomes("value"), graph, optimizer)
    moments = optimizer.init(params)
    values = []
    for k in range(60):
        params, rest, moments, loss = step(params, rest, moments, {"grasp": batch}, jax.random.key(k))
        values.append(float(loss))
    assert np.mean(values[-5:]) < 0.5 * np.mean(values[:5])
    assert jnp.isfinite(loss)


@pytest.mark.slow
def test_a_loss_that_is_not_finite_ends_a_run_with_one_line(engine: Any, tmp_path: pathlib.Path) -> None:
    config = baseline.BaselineConfig("rea", actions=8, tables=2, updates=2, batch=2, learning_rate=1e39)
    with pytest.raises(UserError, match="not finite") as said:
        baseline.learn(engine, CONFIG, config, tmp_path)
    assert "\n" not in str(said.value) and not (tmp_path / "checkpoints").exists()
