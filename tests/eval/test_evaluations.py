"""Every evaluation on a tiny scale, with networks that have learnt nothing; and the arithmetic of the figures."""

import copy
import json
import pathlib
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.eval import metrics
from dipn_jax.eval.clearing import film, instances, lockstep, methods
from dipn_jax.eval.grasping import success
from dipn_jax.eval.prediction import push_errors
from dipn_jax.eval.report import comparison, page
from flax import nnx

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.planning import candidates, policy
from dipn_jax.sight import render
from dipn_jax.storage import checkpoint
from dipn_jax.storage.resume import Partial
from dipn_jax.structs import Push, Scene
from dipn_jax.world import cases, clutter, primitives, scenes

CONFIG = scenes.fixed_count(3, spread=0.2)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, pathlib.Path]:
    folder = tmp_path_factory.mktemp("runs")
    for name, config in (("dipn", DipnConfig(width=8)), ("grasp", GraspConfig(width=8))):
        model = checkpoint.build(name, config)
        checkpoint.save(folder / name, 1, {"model": nnx.state(model)}, network=name, config=config, extra={})
        (folder / name / "metrics.jsonl").write_text('{"step": 1, "loss": 1.0}\n{"step": 2, "loss": 0.5}\n')
    return {name: folder / name for name in ("dipn", "grasp")}


def test_interval_holds_the_ratio(rng: np.random.Generator) -> None:
    trials = rng.integers(1, 10, 200)
    hits = rng.binomial(trials, 0.7)
    value, low, high = metrics.ratio_interval(hits, trials)
    assert value == hits.sum() / trials.sum()
    assert low < value < high
    # as wide as the binomial's: every attempt is independent here
    assert high - low == pytest.approx(2 * 1.96 * np.sqrt(0.21 / trials.sum()), rel=0.15)
    assert np.isnan(metrics.ratio_interval(np.zeros(3), np.zeros(3))[0])


def test_calibration_error_of_known_scores() -> None:
    for held, error in ((1, 0.05), (0, 0.95)):
        found = success.calibration(np.full(10, 0.95), np.full(10, held))
        assert found["expected_calibration_error"] == pytest.approx(error)
        assert found["reliability/9/count"] == 10 and found["reliability/9/success"] == held


def _ended(name: str, steps: list[str], removed: int, objects: int) -> instances.Instance:
    instance = instances.Instance("x", None, np.zeros((1, 7)), objects)  # type: ignore[arg-type]
    instance.ended, instance.removed = name, removed
    instance.did = steps
    instance.pushes, instance.held = steps.count("push"), steps.count("grasp held")
    instance.grasps = len(steps) - instance.pushes
    return instance


def test_summary_counts_as_the_paper_does() -> None:
    rows = [
        _ended("cleared", ["push", "grasp held", "grasp missed", "grasp held"], 2, 2),
        _ended("pushed out", ["grasp held", "push"], 1, 3),
    ]
    values = lockstep.summary(rows)
    assert values["completion"] == 0.5
    assert values["grasp_success_all"] == 3 / 4 and values["grasp_success_completed"] == 2 / 3
    assert values["efficiency_all"] == 3 / 6 and values["efficiency_completed"] == 2 / 4
    assert values["grasps_that_held"] == 3 / 4 and values["pushes"] == 2 and values["ended_pushed_out"] == 1


def test_a_case_that_does_not_come_to_rest_is_named(engine: Any, tmp_path: pathlib.Path) -> None:
    box = {"shape": "cuboid", "size_mm": [50, 50, 50], "position_m": [0, 0], "quaternion_wxyz": [1, 0, 0, 0]}
    pair = [box | {"position_m": [0.18, 0]}, box | {"position_m": [0.22, 0]}]  # they overlap: one is thrown out
    path = tmp_path / "cases.json"
    path.write_text(
        json.dumps(
            {
                "cases": [
                    {"name": "a", "objects": [box]},
                    {"name": "b/..", "objects": pair},
                ]
            }
        )
    )
    with pytest.raises(UserError, match=r"case b/\.\. of .* does not come to rest"):
        instances.hard_instances(engine, path, None, slots=2, repeats=1, seed=0)


def test_prediction_measures_the_baselines_as_they_are(
    engine: Any, runs: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    network = {"dipn": checkpoint.load_network(runs["dipn"], network="dipn")}
    values, films = push_errors.evaluate(
        network, engine, CONFIG, Partial(tmp_path, {}), scenes=6, seed=3, physics=True, segmented=True
    )
    assert values["pushes"] == 6 and len(films["before"]) > 0
    # the engine with nominal mass and friction is nearer to the truth than nothing-moves
    assert values["push_error/physics/10cm/moved"] < values["push_error/static/10cm/moved"]
    assert values["push_error/static/5cm/all"] < values["push_error/static/10cm/all"]
    for key, value in values.items():
        assert np.isfinite(value), key


def test_static_is_the_difference_of_two_renders(engine: Any, settled: Any) -> None:
    seen = jax.tree.map(np.asarray, render.observe(settled.scene, settled.poses))
    truth = np.repeat(settled.poses[:, None], 3, 1)
    truth[:, 1:, 0, 0] += 0.01
    after = push_errors._labels_after(settled.scene, truth)
    pushes = Push(np.zeros((6, 2), np.float32), np.zeros(6, np.float32), np.full(6, 0.05, np.float32))
    rows: push_errors.Rows = {}
    static = {"static": push_errors._at_distances(policy.static_predictor(5))}
    push_errors.measure(rows, "", static, seen, seen, pushes, truth, after, None)
    for b in range(6):
        for i in range(5):
            was, is_ = seen.label[b] == i, after[b, 0] == i
            either = (was | is_).sum()
            want = 1 - (was & is_).sum() / either if either else 0.0
            np.testing.assert_allclose(rows["static/push_error"][0][b, 0, i], want, atol=1e-6)
        assert rows["moved"][0][b, 0].tolist() == [bool((seen.label[b] == 0).any()), False, False, False, False]


def test_grasp_evaluation_writes_what_it_promises(
    engine: Any, runs: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    scorer = policy.load_scorer(runs["grasp"])
    values, tables = success.evaluate(scorer, engine, CONFIG, Partial(tmp_path, {}), scenes=3, seed=3, others=2)
    assert values["attempts"] == sum(table.grasps for table in tables) >= 3 and values["scenes"] == 3
    assert sum(value for key, value in values.items() if key.startswith("table/")) == 3
    assert 0 <= values["other_grasps/ceiling"] <= 1
    for name in ("gn", "random_foreground"):
        assert 0 <= values[f"grasp_success/{name}_low"] <= values[f"grasp_success/{name}"] <= 1


def test_labels_of_pretraining_mostly_say_what_physics_says(engine: Any) -> None:
    found = success.label_agreement(engine, scenes.fixed_count(1), scenes=16, seed=0)
    assert found["grasps"] > 48 and 0.1 < found["positive"] < 0.9
    assert found["agree"] > 0.7


@pytest.fixture(scope="module")
def cleared(engine: Any, runs: dict[str, pathlib.Path], tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Two hard cases acted on by networks that know nothing: one by grasps, one by pushes."""
    out = tmp_path_factory.mktemp("clear")
    nets = methods.Nets(push=runs["dipn"], grasp=runs["grasp"])

    def table(name: str) -> list[instances.Instance]:
        return instances.hard_instances(engine, cases.hard_cases_path(), [name], slots=6, repeats=1, seed=0)

    grasps = methods.load(methods.Plan(candidates=4, threshold=0.0), nets, engine, slots=6)
    grasped = lockstep.clear(table("06"), engine, grasps, Partial(out, {"case": "06"}), seed=0)
    tables = table("10")
    decide = methods.load(methods.Plan(candidates=4, threshold=2.0, gamma=1.05), nets, engine, slots=6)
    # interrupted after the second turn, then taken up by a fresh call
    partial = Partial(out, {})
    save = partial.save

    def stop_at_two(state: Any) -> None:
        save(state)
        if state[0].actions == 2:
            raise KeyboardInterrupt

    partial.save = stop_at_two  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        lockstep.clear(copy.deepcopy(tables), engine, decide, partial, seed=0)
    tables = lockstep.clear(tables, engine, decide, Partial(out, {}), seed=0)
    assert Partial(out, {"other": 1}).load("fresh") == "fresh"
    tables = grasped + tables
    lockstep.save(tables, out)
    settings = {"method": "dipn+gn", "label": "", "tables.cases": "hard", "tables.objects": "10"}
    metrics.write(out, lockstep.summary(tables), settings=settings)
    return tables, out


def test_every_table_ends_by_the_rules(cleared: Any, tmp_path: pathlib.Path) -> None:
    tables, out = cleared
    for table in tables:
        assert table.ended in ("cleared", "pushed out", "out of actions")
        assert table.actions <= 3 * table.objects and table.actions == len(table.film)
        assert table.removed == table.objects - (table.scene.shape >= 0).sum()
    kinds = {step for table in tables for step in table.did}
    assert "push" in kinds and kinds & {"grasp held", "grasp missed"}
    listed = json.loads((out / "episodes.json").read_text())
    assert [entry["name"] for entry in listed] == ["06", "10"]
    reel = film.load(out / listed[0]["file"])
    assert len(reel.what) == len(tables[0].film) == len(reel.poses) - 1
    before, predicted, _ = reel.pictures(0)
    after = reel.pictures(len(reel.what) - 1)[2]
    assert before.shape == predicted.shape == after.shape == (224, 224, 3)
    assert (before != after).any(), "all actions leave the table as it was"
    cut = tmp_path / "cut.npz"
    for content in (b"", (out / listed[0]["file"]).read_bytes()[:-300]):
        cut.write_bytes(content)
        with pytest.raises(UserError, match="missing, damaged or no film"):
            film.load(cut)


def test_a_saved_episode_can_be_simulated_again(cleared: Any, engine: Any) -> None:
    tables, out = cleared
    for number in range(len(tables)):
        reel = film.load(out / "episodes" / f"{number:03d}.npz")
        scene, poses = Scene(reel.shape[0], reel.size, reel.color, reel.mass, reel.friction), reel.poses[0]
        if reel.what[0] == "push":
            push = Push(reel.push[0, :2], reel.push[0, 2], reel.push[0, 3])
            after = primitives.push(engine, *structs.stack([(scene, poses)]), structs.stack([push])).poses[0, -1]
        else:
            grasp = candidates.grasp_at(reel.grasp[0], render.render(scene, poses).height)
            after = clutter.grasp_away(engine, *structs.stack([(scene, poses)]), structs.stack([grasp]))[1][0]
        np.testing.assert_allclose(after, reel.poses[1], atol=1e-5)


def test_a_table_is_lost_to_a_push_or_to_a_grasp(cleared: Any, tmp_path: pathlib.Path) -> None:
    _, out = cleared
    one = comparison.Cleared(out)
    entry = one.episodes[0]
    last = film.load(out / entry["file"]).what[-1]
    assert comparison._cause(one, entry | {"ended": "out of actions"}) == "out of actions"
    lost = comparison._cause(one, entry | {"ended": "pushed out"})
    assert lost == ("pushed out" if last == "push" else "thrown out") and set(comparison.CAUSES) >= {lost}
    assert comparison._tables_name("hard", "10") == "hard" and comparison._tables_name("random", "30") == "random-30"
    assert (
        comparison._tables_name("my/hard.json", "10") == "own-hard" and comparison._tables_name("my/a.json", "") == "a"
    )


def test_learning_curves_show_whatever_lines_have(tmp_path: pathlib.Path) -> None:
    lines = [{"step": 10, "reward/grasp": 0.5}, {"step": 20, "reward/push": 0.25}, {"step": 30, "reward/grasp": 0.75}]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    drawn = {line.get_label(): line.get_xydata().tolist() for line in page._curves([tmp_path]).axes[0].lines}
    assert drawn == {"reward/grasp": [[10, 0.5], [30, 0.75]], "reward/push": [[20, 0.25]]}


def test_the_course_of_clearing_is_what_was_left_after_each_action(cleared: Any) -> None:
    tables, out = cleared
    shares = comparison.course(comparison.Cleared(out), np.array([0.0, 3.0]))
    left = [(table.scene.shape >= 0).sum() / table.objects for table in tables]
    np.testing.assert_allclose(shares, [1.0, np.mean(left)])
    after = [(t.film[min(t.objects, len(t.film) - 1)]["shape"] >= 0).sum() / t.objects for t in tables]
    late = [(t.scene.shape >= 0).sum() / t.objects for t in tables]
    wanted = np.mean([a if len(t.film) > t.objects else b for t, a, b in zip(tables, after, late, strict=True)])
    np.testing.assert_allclose(comparison.course(comparison.Cleared(out), np.ones(1)), wanted)


def test_the_report_is_one_file_with_its_pictures(
    cleared: Any, engine: Any, runs: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    network = {"dipn": checkpoint.load_network(runs["dipn"], network="dipn")}
    values, films = push_errors.evaluate(
        network, engine, CONFIG, Partial(tmp_path, {}), scenes=2, seed=3, physics=False, segmented=False
    )
    (tmp_path / "p").mkdir()
    np.savez_compressed(tmp_path / "p" / "films.npz", **films)  # type: ignore[arg-type]
    metrics.write(tmp_path / "p", values, settings={})
    options: dict[str, Any] = {"grasp": None, "clears": [cleared[1]], "sweep": None, "runs": list(runs.values())}
    merged = page.write(tmp_path, prediction=tmp_path / "p", **options)
    written = (tmp_path / "report.html").read_text()
    assert written.count("data:image/png;base64,") == 5
    assert "74.4" in written, "the paper's numbers stand beside"
    assert 'src="http' not in written and "href=" not in written
    assert merged["clear/hard/dipn+gn/completion"] == metrics.read(cleared[1])["completion"]
    assert (
        json.loads((tmp_path / "metrics.json").read_text())["push_error/dipn/5cm/all"]
        == values["push_error/dipn/5cm/all"]
    )
