"""What is counted of a table, what ends it and which misses are remembered, without a policy and an engine."""

import numpy as np
import pytest
from dipn_jax.eval.clearing import instances, lockstep

from dipn_jax.structs import ABSENT, Scene
from dipn_jax.workspace import WORKSPACE


def _ended(name: str, steps: list[str], removed: int, objects: int, case: str = "x") -> instances.Instance:
    instance = instances.Instance(case, None, np.zeros((1, 7)), objects)  # type: ignore[arg-type]
    instance.ended, instance.removed = name, removed
    instance.did = steps
    instance.pushes, instance.held = steps.count("push"), steps.count("grasp held")
    instance.grasps = len(steps) - instance.pushes
    return instance


def test_summary_counts_as_the_paper_does() -> None:
    rows = [
        _ended("cleared", ["push", "grasp held", "grasp missed", "grasp held"], 2, 2),
        _ended("pushed out", ["grasp held", "push"], 1, 3, "y"),
    ]
    values = lockstep.summary(rows)
    assert values["completion"] == 0.5
    assert values["grasp_success_all"] == 3 / 4 and values["grasp_success_completed"] == 2 / 3
    assert values["efficiency_all"] == 3 / 6 and values["efficiency_completed"] == 2 / 4
    assert values["grasps_that_held"] == 3 / 4 and values["pushes"] == 2 and values["ended_pushed_out"] == 1
    assert values["instances"] == 2 and values["grasps"] == 4 and values["ended_cleared"] == 1
    assert values["ended_fault"] == 0 and values["ended_out_of_actions"] == 0
    assert (values["completion_low"], values["completion_high"]) == (0.0, 1.0)


def _table(shape: list[int], places: list[tuple[float, ...]], *, actions: int = 0) -> instances.Instance:
    """Return a table of two objects at the places (x, y, z), of which those whose shape is ABSENT are gone."""
    ones = np.ones(len(shape), np.float32)
    scene = Scene(np.array(shape), np.full((len(shape), 3), 0.05), np.ones((len(shape), 3)), ones, ones)
    poses = np.array([[*place, 1, 0, 0, 0] for place in places], float)
    table = instances.Instance("x", scene, poses, len(shape))
    table.pushes = actions
    return table


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_centre_beyond_the_edge_is_pushed_out(axis: int, sign: int) -> None:
    for beyond, want in ((0.0, ""), (1e-6, "pushed out")):
        place = [0.0, 0.0, 0.02]
        place[axis] = sign * (WORKSPACE.half + beyond)
        assert lockstep._ended(_table([0, 3], [(0, 0, 0), tuple(place)])) == want
        assert lockstep._ended(_table([3, 0], [(0, 0, 0), tuple(place)])) == want
        assert lockstep._ended(_table([0, ABSENT], [(0, 0, 0), tuple(place)])) == "", "what is gone is not pushed out"
    assert lockstep._ended(_table([0, 0], [(0, 0, 0), (0, 0, 0.5)])) == "", "however high it is"


def test_a_table_is_cleared_before_its_actions_count() -> None:
    here = [(0.0, 0.0, 0.0)] * 2
    for actions in (0, 6, 7):
        assert lockstep._ended(_table([ABSENT, ABSENT], here, actions=actions)) == "cleared"
    wanted = {0: "", 5: "", 6: "out of actions", 7: "out of actions"}
    assert {n: lockstep._ended(_table([0, ABSENT], here, actions=n)) for n in wanted} == wanted


def test_misses_are_forgotten_where_the_table_has_changed() -> None:
    before = np.zeros((WORKSPACE.pixels, WORKSPACE.pixels), np.float32)
    after = before.copy()
    after[90:130, 90:130] = 0.05
    tables = [_table([0, 0], [(0, 0, 0)] * 2) for _ in range(2)]
    for table in tables:
        table.missed = table.missed.add(np.array([3, 110, 110]), before)
    found = lockstep._recall(tables, np.stack([before, after]))
    np.testing.assert_array_equal(found[0, 0], [3, 110, 110])
    assert (found[1] == -1).all() and (found[0, 1:] == -1).all()
