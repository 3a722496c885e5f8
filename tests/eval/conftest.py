"""Fixtures for the tests of evaluations: networks with random weights, and tables that they acted on."""

import copy
import pathlib
from typing import Any

import pytest
from dipn_jax.eval import metrics
from dipn_jax.eval.clearing import instances, lockstep, on_tables
from flax import nnx

from dipn_jax.networks.dipn import DipnConfig
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.planning.methods import Networks
from dipn_jax.planning.policy_config import PolicyConfig
from dipn_jax.storage import checkpoint
from dipn_jax.storage.resume import Partial
from dipn_jax.world import cases


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, pathlib.Path]:
    """Return runs of networks with random weights."""
    folder = tmp_path_factory.mktemp("runs")
    for name, config in (("dipn", DipnConfig(width=8)), ("grasp", GraspConfig(width=8))):
        model = checkpoint.build(name, config)
        checkpoint.save(folder / name, 1, {"model": nnx.state(model)}, network=name, config=config, extra={})
        (folder / name / "metrics.jsonl").write_text('{"step": 1, "loss": 1.0}\n{"step": 2, "loss": 0.5}\n')
    return {name: folder / name for name in ("dipn", "grasp")}


@pytest.fixture(scope="session")
def tiny(runs: dict[str, pathlib.Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, pathlib.Path]:
    """Return runs of networks with random weights, of which GN is as small as can be."""
    folder, config = tmp_path_factory.mktemp("tiny"), GraspConfig(width=8, coarse=8, blocks=1)
    model = checkpoint.build("grasp", config)
    checkpoint.save(folder / "grasp", 1, {"model": nnx.state(model)}, network="grasp", config=config, extra={})
    return runs | {"grasp": folder / "grasp"}


@pytest.fixture(scope="session")
def cleared(engine: Any, runs: dict[str, pathlib.Path], tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return two hard cases on which networks with random weights acted: one by grasps, one by pushes."""
    out = tmp_path_factory.mktemp("clear")
    networks = Networks(push=runs["dipn"], grasp=runs["grasp"])

    def table(name: str) -> list[instances.Instance]:
        return instances.case_instances(engine, cases.hard_cases_path(), [name], slots=6, repeats=1, seed=0)

    def load(**config: Any) -> on_tables.TablePolicy:
        return on_tables.load("dipn+gn", networks, engine, [PolicyConfig(candidates=4, **config)])[0]

    grasps = load(grasp_above=0.0)
    grasped = lockstep.clear(table("06"), engine, grasps, Partial(out, {"case": "06"}), seed=0)
    tables = table("10")
    decide = load(grasp_above=2.0, gamma=1.05)
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
