"""How a table ends, by simulations whose results are given."""

import dataclasses
import pathlib
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.eval.clearing import film, lockstep
from dipn_jax.eval.clearing.instances import Instance

from dipn_jax.planning import planner
from dipn_jax.storage.resume import Partial
from dipn_jax.structs import ABSENT, Decision, Fault, Grasp, Observation, Push, Scene
from dipn_jax.system import files
from dipn_jax.workspace import WORKSPACE
from dipn_jax.world import scenes

OBJECTS = 2


@dataclasses.dataclass
class Script:
    """A policy and an engine: what is done at each action, and how it ends."""

    steps: list[tuple[str, Any]]
    done: int = 0
    longest: float = 0.0

    def decide(self, keys: jax.Array, scene: Scene, poses: np.ndarray, recall: Any) -> Any:
        """Push or grasp as the script says."""
        empty, label = np.zeros((1, 224, 224, 3), np.float32), np.full((1, 224, 224), -1, np.int32)
        seen = Observation(empty[..., 0], empty, label, slots=OBJECTS)
        recall(seen.height)
        zero = np.zeros(1, np.float32)
        decision = Decision(
            is_push=np.array([self.steps[self.done][0] == "push"]),
            push=Push(np.zeros((1, 2), np.float32), zero, zero),
            grasp=Grasp(np.zeros((1, 2), np.float32), zero, zero),
            grasp_pixel=np.zeros((1, 3), np.int32),
            grasp_score=zero,
            value_now=zero,
            value_push=zero,
            motion=np.zeros((1, OBJECTS, 3), np.float32),
        )
        return decision, seen

    def push(self, engine: Any, scene: Scene, poses: np.ndarray, push: Push, *, longest: float) -> Any:
        """Move the first object to where the script says, or fail."""
        what = self._next()
        after = poses.copy()
        if not isinstance(what, Fault):
            after[0, 0, 0] = what
        fault = np.array([what if isinstance(what, Fault) else 0])
        self.longest = longest
        return type("Rollout", (), {"poses": np.stack([poses, poses, after], 1), "fault": fault})

    def grasp_away(self, engine: Any, scene: Scene, poses: np.ndarray, grasp: Grasp) -> Any:
        """Hold the objects that the script names, or fail."""
        what = self._next()
        held = np.zeros((1, OBJECTS), bool)
        if not isinstance(what, Fault):
            held[0, list(what)] = True
        scene, after = jax.device_get(scenes.remove(scene, poses, held))
        return scene, after, held, np.array([what if isinstance(what, Fault) else 0])

    def _next(self) -> Any:
        self.done += 1
        return self.steps[self.done - 1][1]


class Shown:
    """Stands for `console.Progress`: what the user was told."""

    def __init__(self, title: str, total: int, *, unit: str, done: int = 0) -> None:
        self.total, self.done, self.notes = total, done, list[str]()

    def __enter__(self) -> "Shown":
        return self

    def __exit__(self, *error: Any) -> None:
        assert self.done <= self.total

    def advance(self, amount: int, note: str = "") -> None:
        """Count what is done, and keep the note."""
        self.done += amount
        self.notes.append(note)


def _play(
    steps: list[tuple[str, Any]], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, **options: Any
) -> Instance:
    script = Script(steps)
    monkeypatch.setattr(lockstep.primitives, "push", script.push)
    monkeypatch.setattr(lockstep.clutter, "grasp_away", script.grasp_away)
    shape, ones = np.zeros(OBJECTS, np.int32), np.ones(OBJECTS, np.float32)
    scene = Scene(shape, np.full((OBJECTS, 3), 0.05, np.float32), np.ones((OBJECTS, 3), np.float32), ones, ones)
    poses = np.array([[0, 0, 0.025, 1, 0, 0, 0], [0.1, 0, 0.025, 1, 0, 0, 0]], np.float32)
    table = Instance("one", scene, poses, OBJECTS)
    partial = Partial(tmp_path, {})
    shown = Shown("", OBJECTS, unit="objects")
    monkeypatch.setattr(lockstep.console, "Progress", lambda *_, done, **__: shown)
    (ended,) = lockstep.clear([table], None, script.decide, partial, seed=0, **options)  # type: ignore[arg-type]
    partial.finish()
    assert script.done == ended.actions == len(ended.film)
    assert script.longest in (0.0, 0.1), "the longest push of a data set by default"
    assert shown.done == ended.removed and shown.notes[-1] == "1/1 tables ended" and len(shown.notes) == ended.actions
    assert all(note == "0/1 tables ended" for note in shown.notes[:-1])
    return ended


def test_an_object_pushed_out_by_the_third_action_ends_the_table(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = [("grasp", ()), ("push", 0.05), ("push", WORKSPACE.half + 0.001), ("grasp", (0, 1))]
    ended = _play(steps, tmp_path, monkeypatch)
    assert (ended.ended, ended.pushes, ended.grasps, ended.removed) == ("pushed out", 2, 1, 0)
    values = lockstep.summary([ended])
    assert values["ended_pushed_out"] == 1 and values["completion"] == 0 and values["pushes"] == 2
    assert _play([("push", WORKSPACE.half - 0.001), ("grasp", (0, 1))], tmp_path, monkeypatch).ended == "cleared"


@pytest.mark.parametrize("action", ["push", "grasp"])
def test_a_simulation_that_went_wrong_ends_the_table(
    action: str, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[tuple[str, Any]] = [("grasp", (0,)), (action, Fault.NON_FINITE), ("grasp", (1,))]
    ended = _play(steps, tmp_path, monkeypatch)
    assert (ended.ended, ended.actions, ended.removed) == ("fault", 2, 1)
    values = lockstep.summary([ended])
    assert values["ended_fault"] == 1 and values["completion"] == 0 and values["efficiency_all"] == 1 / 2


def test_a_table_is_cleared_when_nothing_is_left(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = _play([("grasp", (0,)), ("push", 0.0), ("grasp", ()), ("grasp", (1,))], tmp_path, monkeypatch)
    assert (ended.ended, ended.removed, ended.held, ended.grasps, ended.pushes) == ("cleared", 2, 2, 3, 1)
    both = _play([("grasp", (0, 1))], tmp_path, monkeypatch)
    values = lockstep.summary([both])
    assert both.held == 1 and values["grasp_success_all"] == 2 and values["grasps_that_held"] == 1


def test_a_table_ends_after_three_actions_an_object(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = _play([("grasp", ())] * 3 + [("push", 0.0)] * 4, tmp_path, monkeypatch)
    assert (ended.ended, ended.actions) == ("out of actions", 3 * OBJECTS)
    last = _play([("grasp", ())] * 5 + [("grasp", (0, 1))], tmp_path, monkeypatch)
    assert last.ended == "cleared", "the last action counts"


def test_every_action_is_recorded_and_saved(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = _play([("grasp", (0,)), ("push", 0.05), ("grasp", (1,))], tmp_path / "work", monkeypatch)
    assert [step["shape"].tolist() for step in ended.film] == [[0, 0], [ABSENT, 0], [ABSENT, 0]]
    assert [step["poses"][1, 0] for step in ended.film] == pytest.approx([0.1, 0.1, 0.1])
    lockstep.save([ended, ended], tmp_path)
    listed = files.read_json(tmp_path / "episodes.json", wanted=list)
    counted = {"objects": 2, "removed": 2, "held": 2, "grasps": 2, "pushes": 1}
    assert listed[1] == {"name": "one", "file": "episodes/001.npz", "ended": "cleared", **counted}
    assert all((tmp_path / line["file"]).is_file() for line in listed) and len(listed) == 2


def test_the_policy_is_told_of_misses_only_where_it_remembers(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = _play([("grasp", ()), ("grasp", (0, 1))], tmp_path, monkeypatch)
    np.testing.assert_array_equal(ended.film[0]["missed"][0], planner.NONE_MISSED[0])
    np.testing.assert_array_equal(ended.film[1]["missed"][0], [0, 0, 0])
    bare = _play([("grasp", ()), ("grasp", (0, 1))], tmp_path, monkeypatch, remember=False)
    assert (bare.film[1]["missed"] == -1).all()
    later = _play([("push", 0.02), ("grasp", ()), ("push", 0.03), ("grasp", (0, 1))], tmp_path, monkeypatch)
    assert [int((step["missed"][:, 0] >= 0).sum()) for step in later.film] == [0, 0, 1, 1], "no push is a miss"


def test_every_step_of_a_table_is_saved_as_it_was(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = _play([("grasp", (0,)), ("push", 0.05), ("grasp", (1,))], tmp_path, monkeypatch)
    lockstep.save([ended], tmp_path)
    (entry,) = files.read_json(tmp_path / "episodes.json", wanted=list)
    assert entry["file"] == "episodes/000.npz" and (entry["held"], entry["pushes"]) == (2, 1)
    reel = film.load(tmp_path / entry["file"])
    np.testing.assert_array_equal(reel.shape, [[0, 0], [-1, 0], [-1, 0], [-1, -1]])
    np.testing.assert_allclose(reel.poses[0, :, 0], [0, 0.1])
    np.testing.assert_allclose(reel.poses[2, 0, 0], 0.05)
    assert reel.what.tolist() == ["grasp held", "push", "grasp held"]
