"""Methods that clear tables: the networks they need, decisions in lockstep, sweeps."""

import dataclasses
import pathlib
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.eval import metrics
from dipn_jax.eval.clearing import camera, instances, on_tables, sweep_command, sweeping
from dipn_jax.eval.clearing.tables import Tables
from flax import nnx

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.names import ALL_AIDS
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.networks.vpg import VpgConfig
from dipn_jax.planning import planner, predictors
from dipn_jax.planning.methods import METHODS, Networks
from dipn_jax.planning.policy_config import PolicyConfig
from dipn_jax.storage import checkpoint
from dipn_jax.world import cases, scenes

CONFIGS: dict[str, tuple[str, Any]] = {
    "push": ("dipn", DipnConfig(width=8)),
    "grasp": ("grasp", GraspConfig(width=8, coarse=8, blocks=1)),
    "value": ("vpg", VpgConfig(width=8, coarse=8)),
    "only": ("vpg", VpgConfig(parts=("grasp",), width=8, coarse=8)),
    "chances": ("vpg", VpgConfig(parts=("grasp",), answers="chance", width=8, coarse=8)),
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, pathlib.Path]:
    """Return runs of networks with random weights."""
    folder = tmp_path_factory.mktemp("runs")
    for name, (network, config) in CONFIGS.items():
        model = checkpoint.build(network, config)
        checkpoint.save(folder / name, 1, {"model": nnx.state(model)}, network=network, config=config, extra={})
    return {name: folder / name for name in CONFIGS}


def _networks(runs: dict[str, pathlib.Path]) -> Networks:
    return Networks(runs["push"], runs["grasp"], runs["value"])


def _load(method: str, networks: Networks, engine: Any, **config: Any) -> Any:
    seen = camera.Camera(masks="true" if method == "physics+gn" else "found")
    decide = on_tables.load(method, networks, engine, [PolicyConfig(**config)], camera=seen)[0]
    return lambda *args: decide(*args[:3], lambda _: args[3])[0]


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_decides_on_every_table_by_itself(
    method: Any, engine: Any, settled: Any, runs: dict[str, pathlib.Path]
) -> None:
    best = tuple(aid for aid in ALL_AIDS if aid != "top")  # the grasp of the highest score is made
    config = {"candidates": 3, "grasp_above": 0.9, "gamma": 1.2, "aids": best}
    networks = _networks(runs)
    if method == "rea+dipn":
        networks = dataclasses.replace(networks, value=runs["chances"])
    decide = _load(method, networks, engine, **config)
    keys = jax.random.split(jax.random.key(0), 3)
    scene, poses = structs.take(settled.scene, slice(0, 3)), settled.poses[:3]
    none = np.tile(planner.NONE_MISSED, (3, 4, 1))
    together = decide(keys, scene, poses, none)
    assert together.is_push.shape == (3,) and together.motion.shape == (3, 5, 3)
    alone = decide(keys[1:2], structs.take(scene, slice(1, 2)), poses[1:2], none[1:2])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[1:2], b, atol=1e-6), together, alone)
    missed = np.concatenate([none[:, 1:], together.grasp_pixel[:, None]], 1)
    doubting = decide(keys, scene, poses, missed)
    assert (doubting.grasp_score < together.grasp_score).all() and (doubting.grasp_pixel != missed[:, -1]).any()
    if method == "gn":
        assert not together.is_push.any()
        rash = _load(method, networks, engine, aids=("table",))
        assert (rash(keys, scene, poses, none).grasp_score > together.grasp_score).all()
    if method == "dipn+gn+actions":
        assert (together.value_now <= 0).all(), "what is compared is no number of misses"
    elif method == "dipn+gn":
        assert (together.value_now > 0).all(), "what is compared is no mean score"
    if method == "physics+gn":
        assert np.abs(together.motion).max() > 0.01, "the engine was not asked, or moved nothing"


def test_a_method_without_its_network_is_refused(engine: Any, runs: dict[str, pathlib.Path]) -> None:
    for method, net in (("dipn+gn", "push"), ("vpg", "value"), ("physics+gn", "grasp")):
        with pytest.raises(UserError, match=f"--method {method.replace('+', '.')}: needs --{net}-net"):
            _load(method, Networks(), engine)
    grasps_only = Networks(None, runs["grasp"], runs["only"])
    with pytest.raises(UserError, match="was not trained to push"):
        _load("dqn+gn", grasps_only, engine)
    with pytest.raises(UserError, match="predicts values, not chances"):
        _load("rea+dipn", _networks(runs), engine)
    with pytest.raises(UserError, match="holds a grasp network, want vpg"):
        _load("vpg", Networks(value=runs["grasp"]), engine)
    with pytest.raises(UserError, match="--method search"):
        _load("search", Networks(), engine)


def test_each_candidate_takes_one_of_several_distances() -> None:
    config = PolicyConfig(candidates=5, distances=(0.03, 0.06))
    np.testing.assert_allclose(config.candidate_distances(), [0.03, 0.06, 0.03, 0.06, 0.03])


def test_tables_are_a_case_file_or_random() -> None:
    assert Tables().path() == cases.hard_cases_path() and Tables().slots() == 6
    assert Tables("random", objects="1:7").path() is None and Tables("random", objects="1:7").slots() == 7
    with pytest.raises(UserError, match="--instances 0"):
        Tables(instances=0)
    with pytest.raises(UserError, match="--names: random tables have none"):
        Tables("random", names=("a",))


def test_a_repeat_of_a_case_does_not_depend_on_the_number_of_repeats(engine: Any) -> None:
    path = cases.hard_cases_path()
    names, scene, poses = cases.load_cases(path, slots=6)
    few, more = (instances.case_instances(engine, path, names[1:3], slots=6, repeats=count, seed=0) for count in (2, 3))
    assert [each.name for each in more] == [names[1]] * 3 + [names[2]] * 3
    for here, there in zip(few, [more[0], more[1], more[3], more[4]], strict=True):
        np.testing.assert_array_equal(here.scene.mass, there.scene.mass)
        np.testing.assert_allclose(here.poses, there.poses, atol=1e-6)
    assert [table.number for table in few] == [more[i].number for i in (0, 1, 3, 4)]
    assert len({table.number for table in more}) == 6, "each has random numbers of its own"
    placed = instances.case_instances(engine, path, names[1:2], slots=6, repeats=1, seed=0, perturbed=False)[0]
    np.testing.assert_array_equal(placed.scene.mass, scene.mass[1])
    assert (more[0].scene.mass != scene.mass[1])[scene.shape[1] >= 0].all(), "the first repeat is as it is placed"
    there = scene.shape[1] >= 0
    factor = more[1].scene.mass[there] / scene.mass[1][there]
    assert (
        (np.abs(factor - 1) <= 0.2).all() and (factor != 1).all() and (more[1].scene.mass != more[2].scene.mass).any()
    )
    moved = np.linalg.norm(more[1].poses[there, :2] - poses[1][there, :2], axis=-1)
    assert moved.min() > 0 and moved.max() < 2 * instances.JITTER  # and what overlap has pushed apart


def test_a_sweep_has_a_candidate_for_every_distance(tmp_path: pathlib.Path) -> None:
    builtin = pathlib.Path("builtin")
    with pytest.raises(UserError, match="--candidates 1: want at least one for each of the 2 distances"):
        sweep_command.sweep(tmp_path, builtin, builtin, "0.03:0.04:0.01", Tables("random"), candidates=1)


def test_distances_are_parsed_and_invalid_ones_are_refused() -> None:
    assert sweeping.parse("0.03:0.12:0.01") == tuple(round(0.03 + 0.01 * i, 6) for i in range(10))
    assert sweeping.parse("0.05:0.05:0.01") == (0.05,)
    for wrong in ("0.03", "a:b:c", "0.1:0.03:0.01", "0.03:0.1:0", "0.03:0.1:0.02"):
        with pytest.raises(UserError, match="--distances"):
            sweeping.parse(wrong)


def test_a_sweep_continues_at_the_distance_where_it_was_stopped(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def clear(out: pathlib.Path, *_: Any, **__: Any) -> dict[str, Any]:
        asked.append(out.name)
        if asked == ["0.03", "0.04"]:
            raise KeyboardInterrupt
        return {"completion": 1.0, "pushes": len(asked)}

    def sweep(seed: int) -> None:
        builtin = pathlib.Path("builtin")
        sweep_command.sweep(tmp_path, builtin, builtin, "0.03:0.04:0.01", Tables("random"), pushes=0, seed=seed)

    monkeypatch.setattr(sweep_command.evaluation, "clear", clear)
    with pytest.raises(KeyboardInterrupt):
        sweep(1)
    sweep(1)
    assert asked == ["0.03", "0.04", "0.04", "chosen"]
    assert metrics.read(tmp_path)["sweep/0.03/pushes"] == 1 and metrics.read(tmp_path)["sweep/0.04/pushes"] == 3


def test_a_longer_push_is_harder_to_predict(engine: Any) -> None:
    config = scenes.fixed_count(3, spread=0.2)
    found = sweeping.measured(predictors.static_predictor, engine, config, (0.03, 0.12), scenes=6, seed=0, longest=0.12)
    values = sweeping.error_rates(found, ["0.03", "0.12"])
    near, far = (values[f"sweep/{name}/push_error/all"] for name in ("0.03", "0.12"))
    assert 0 <= near < far <= 1
    figures = {f"sweep/{name}/completion": 1.0 for name in ("0.03", "0.12", "chosen")}
    assert "chosen" in sweeping.table(values | figures)


def test_a_sweep_is_drawn_at_its_distances_and_the_chosen_one_as_a_line() -> None:
    swept = {f"sweep/{name}/completion": done for name, done in (("0.12", 0.5), ("0.03", 0.75), ("chosen", 1.0))}
    axes = sweeping.figure(swept | {"sweep/0.03/completion_low": 0.25, "sweep/0.12/completion_low": 0.125}).axes
    drawn = {axis.get_title(): [line.get_xydata().tolist() for line in axis.lines] for axis in axes}
    value, low, _, chosen = drawn["completion"]
    assert (value, low) == ([[3.0, 0.75], [12.0, 0.5]], [[3.0, 0.25], [12.0, 0.125]])
    assert chosen == [[0.0, 1.0], [1.0, 1.0]], "from side to side"
    assert np.isnan(drawn["push error, moved"][0][0][1]) and len(drawn["push error, moved"]) == 3
