"""What pushes saved, from rows that are known."""

import pathlib
from typing import Any

import numpy as np
from dipn_jax.eval.clearing.instances import Instance

from dipn_jax import structs
from dipn_jax.system import files
from experiments import pages, push_or_grasp

ROW: dict[str, Any] = {
    "case": "01", "objects": 4, "score": 0.3, "mean_ratio": 2.5, "shortfall": 2.3, "pushed": True, "grasps_alone": 7,
    "push_first": 5, "cleared": [True, True],
}  # fmt: skip


def test_what_pushes_save_is_counted_where_they_would_be_made() -> None:
    worse = ROW | {"shortfall": 1.2, "mean_ratio": 1.05, "push_first": 8}
    others = [ROW | {"pushed": False}, ROW | {"mean_ratio": None}]
    others += [ROW | {"cleared": ways} for ways in ([True, False], [False, True])]
    others += [ROW | {"cleared": [False, False], "objects": 1, "case": "02", "pushed": False}]
    lines = push_or_grasp.table({"hard": [ROW, worse, *others], "packed": [worse]}).splitlines()
    assert lines[0].startswith("| pushed where | hard: pushes; saved; only with, only without | packed: ")
    found = {line.split(" | ")[0][2:]: line.split(" | ")[1:] for line in lines[2:] if line.startswith("|")}
    assert found["shortfall over 0.0"] == ["5; +3; 1, 1", "1; -1; 0, 0 |"]
    assert found["shortfall over 2.2"] == ["4; +4; 1, 1", "0; +0; 0, 0 |"]
    assert found["shortfall over 2.4"] == ["0; +0; 0, 0", "0; +0; 0, 0 |"]
    assert found["mean score rises by a factor over 2.00"] == ["3; +2; 1, 1", "0; +0; 0, 0 |"]
    assert found["states"][0] == "7 of 2 cases, 1 with a single object; both ways cleared 4, neither 1"


def test_the_first_unsure_state_is_where_both_ways_begin(settled: Any) -> None:
    def step(score: float, left: int, missed: int) -> dict[str, np.ndarray]:
        shape = np.where(np.arange(5) < left, 0, -1)
        misses = np.full((8, 3), -1)
        misses[:missed] = 7
        return {"values": np.array([score, 0, 0]), "shape": shape, "poses": settled.poses[0] + left, "missed": misses}

    table = Instance("one", structs.take(settled.scene, 0), settled.poses[0], 5, number=11)
    table.film = [step(0.9, 5, 0), step(0.71, 4, 1), step(0.7, 3, 2), step(0.1, 2, 0)]
    assert push_or_grasp._first_unsure(table) == 2
    begun = push_or_grasp._at(table, 2)
    assert len(begun.missed.grasps) == 2 and begun.removed == 2
    assert (begun.objects, begun.actions) == (5, 2), "both ways end after as many actions"
    assert begun.number == table.number != 0, "both ways draw with the same keys"
    np.testing.assert_array_equal(begun.poses, settled.poses[0] + 3)
    table.film = table.film[:2]
    assert push_or_grasp._first_unsure(table) is None


def test_one_push_and_then_the_other_policy() -> None:
    asked: list[str] = []
    first, then = (lambda *_, name=name: asked.append(name) for name in ("push", "grasp"))
    policy = push_or_grasp.PushFirst(first, then)  # type: ignore[arg-type]
    for _ in range(3):
        policy(None, None, None, None)  # type: ignore[arg-type]
    assert asked == ["push", "grasp", "grasp"]


def test_the_table_in_docs_is_that_of_the_kept_states() -> None:
    rows = files.read_json(pages.DOCS / "push-or-grasp.json")
    text = pathlib.Path(pages.DOCS / "clearing.md").read_text()
    assert push_or_grasp.table(rows) in text
