"""Tables are cleared together, and every step is recorded."""

import json
import pathlib
from typing import Any

import numpy as np
import pytest
from dipn_jax.eval.clearing import film

from dipn_jax import structs
from dipn_jax.errors import UserError
from dipn_jax.planning import candidates
from dipn_jax.sight import render
from dipn_jax.structs import Push, Scene
from dipn_jax.world import clutter, primitives


@pytest.mark.slow
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


@pytest.mark.slow
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
