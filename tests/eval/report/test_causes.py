"""Why tables ended, from films made by hand."""

import pathlib
import re

import numpy as np
import pytest
from dipn_jax.eval import metrics
from dipn_jax.eval.clearing import film, lockstep
from dipn_jax.eval.clearing.instances import Instance
from dipn_jax.eval.report import comparison

from dipn_jax.structs import Scene

ENDED = (
    ("a", ["push", "grasp held"], "pushed out", "thrown out"),
    ("b", ["grasp held", "push"], "pushed out", "pushed out"),
    ("c", ["grasp missed"], "pushed out", "thrown out"),
    ("a", ["push", "grasp missed"], "out of actions", "out of actions"),
    ("d", ["push", "grasp held"], "cleared", "cleared"),
    ("e", ["grasp held"], "fault", "fault"),
)
"""Name, actions and end of each table, and what that end was caused by."""


def _table(name: str, did: list[str], ended: str) -> Instance:
    one, three = np.ones(1, np.float32), np.ones((1, 3), np.float32)
    scene = Scene(np.zeros(1, np.int32), three, three, one, one)
    step = {"shape": scene.shape, "poses": np.zeros((1, 7)), "motion": np.zeros((1, 3))}
    step |= {"push": np.zeros(4), "grasp": np.zeros(3), "values": np.zeros(3)}
    step |= {"label": film.packed(np.full((224, 224), -1)), "missed": np.full((8, 3), -1)}
    return Instance(name, scene, np.zeros((1, 7)), 1, ended=ended, did=did, film=[step] * len(did))


@pytest.fixture
def folder(tmp_path: pathlib.Path) -> pathlib.Path:
    """Return results of the tables of ENDED."""
    tables = [_table(*each[:3]) for each in ENDED]
    settings = {"method": "gn", "label": "", "tables.cases": "hard", "tables.objects": "10"}
    metrics.write(tmp_path, lockstep.summary(tables), settings=settings)
    lockstep.save(tables, tmp_path)
    return tmp_path


def test_an_object_is_lost_by_the_last_action(folder: pathlib.Path) -> None:
    one = comparison.Cleared(folder)
    assert [comparison._cause(one, entry) for entry in one.episodes] == [cause for *_, cause in ENDED]


def test_the_table_of_causes_counts_them_and_names_what_was_not_cleared(folder: pathlib.Path) -> None:
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", comparison._causes([comparison.Cleared(folder)]))
    assert list(comparison.CAUSES) == ["cleared", "pushed out", "thrown out", "out of actions", "fault"]
    assert cells[-6:] == ["1", "1", "2", "1", "1", "a (2), b (1), c (1), e (1)"]
