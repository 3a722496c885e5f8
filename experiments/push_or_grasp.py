"""Does a push pay? From the same state: grasps alone to the end, and DIPN's best push first, then grasps alone.

    python -m experiments.push_or_grasp --out results/push-or-grasp

Ten minutes on 2 cores. The states are the first of each table on which no grasp scores over 0.7, of tables that only
set the constants of `dipn_jax/planning/expected_misses.py`: the ten hard ones at a seed of their own, and packed rows
of large blocks. Writes `states.json`, and with `--page` docs/push-or-grasp.json and its table in docs/clearing.md
(the box of that page is written by `python -m experiments.clearing --page`).
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from dipn_jax.eval.clearing import film, lockstep, on_tables
from dipn_jax.eval.clearing.camera import DEFAULT_CAMERA
from dipn_jax.eval.clearing.instances import Instance
from dipn_jax.eval.clearing.on_tables import Recall, TablePolicy
from dipn_jax.eval.clearing.tables import Tables

from dipn_jax.commands import console, markdown
from dipn_jax.engine import Engine
from dipn_jax.physics import make_engine
from dipn_jax.planning import expected_misses, scorers
from dipn_jax.planning.memory import MissedGrasps
from dipn_jax.planning.methods import Networks
from dipn_jax.planning.policy_config import PolicyConfig
from dipn_jax.sight import render
from dipn_jax.storage.resume import Partial
from dipn_jax.structs import Array, Decision, Observation, Scene
from dipn_jax.system import files
from dipn_jax.world.ranges import Ranges
from experiments import pages

SEED = 5
"""Seed of the tables; evaluations have 1,000,000."""
BUILTIN = pathlib.Path("builtin")
LARGE_BLOCKS = ("cuboid_square", "cuboid_long", "cube", "cuboid_mid", "cuboid_flat", "triangle_flat")
"""Items that the gripper can hardly reach around where they stand side by side."""
KINDS = {
    "hard": Tables("hard", instances=8),
    "packed": Tables("random", objects="5:9", instances=80, ranges=Ranges(LARGE_BLOCKS, (0.95, 1.1), packed=1.0)),
}
"""Tables by name."""
PUSHED = PolicyConfig(gamma=50.0, grasp_above=9.0)
"""A rule by which the best push is made, whatever it is worth."""


@dataclasses.dataclass
class PushFirst:
    """A policy that pushes once, on its first call, and then decides as another policy."""

    push: TablePolicy
    then: TablePolicy
    begun: bool = False

    def __call__(self, keys: jax.Array, scene: Scene, poses: Array, recall: Recall) -> tuple[Decision, Observation]:
        """Decide on tables; see `on_tables.TablePolicy`."""
        policy, self.begun = (self.then if self.begun else self.push), True
        return policy(keys, scene, poses, recall)


def compare(engine: Engine, tables: Tables, out: pathlib.Path) -> list[dict[str, Any]]:
    """Return what is known of each state: what a push promised, and how many actions each way took."""
    networks = Networks(BUILTIN, BUILTIN)
    (grasps,) = on_tables.load("gn", networks, engine, [PolicyConfig()], camera=DEFAULT_CAMERA)
    (push,) = on_tables.load("dipn+gn", networks, engine, [PUSHED], camera=DEFAULT_CAMERA)
    made = tables.make(engine, seed=SEED)
    alone = lockstep.clear(made, engine, grasps, Partial(out, {"what": "grasps"}), seed=SEED)
    states = [(table, step) for table in alone if (step := _first_unsure(table)) is not None]
    begun = [_at(table, step) for table, step in states]
    pushed = lockstep.clear(begun, engine, PushFirst(push, grasps), Partial(out, {"what": "push"}), seed=SEED)
    short = _shortfalls([(table, step) for table, step in states])
    return [_row(table, step, after, lack) for (table, step), after, lack in zip(states, pushed, short, strict=True)]


def _first_unsure(table: Instance) -> int | None:
    """Return the first action before which no grasp scored over 0.7; None if there is none."""
    return next((i for i, step in enumerate(table.film) if step["values"][0] <= expected_misses.SURE_SCORE), None)


def _at(table: Instance, step: int) -> Instance:
    """Return a table as it was before an action, with the actions that it had taken, which count."""
    before = table.film[step]
    scene = table.scene.replace(shape=before["shape"])
    height, memory = render.render(scene, before["poses"]).height, MissedGrasps()
    for grasp in before["missed"][before["missed"][:, 0] >= 0]:
        memory = memory.add(grasp, height)
    left = int((before["shape"] >= 0).sum())
    return Instance(
        table.name,
        scene,
        before["poses"].copy(),
        table.objects,
        table.number,
        grasps=step,
        removed=table.objects - left,
        missed=memory,
    )


def _shortfalls(states: Sequence[tuple[Instance, int]]) -> list[float]:
    """Return for each state how far the best grasps of all objects are from sure, summed over objects."""
    estimate = jax.jit(expected_misses.misses_to_come(scorers.load_scorer(BUILTIN)))
    found = []
    for table, step in states:
        before = table.film[step]
        seen = render.render(table.scene.replace(shape=before["shape"]), before["poses"])
        seen = seen.replace(label=film.unpacked(before["label"]).astype(np.int32))
        found.append(float(estimate(seen, before["missed"])) / expected_misses.MISSES_PER_SHORTFALL)
    return found


def _row(table: Instance, step: int, pushed: Instance, lack: float) -> dict[str, Any]:
    values = table.film[step]["values"]
    _, now, after = (float(one) for one in pushed.film[0]["values"])
    return {
        "case": table.name,
        "objects": int((table.film[step]["shape"] >= 0).sum()),
        "score": float(values[0]),
        "mean_ratio": after / PUSHED.gamma / now if np.isfinite(after) and now > 0 else None,
        "shortfall": lack,
        "pushed": pushed.did[0] == "push",
        "grasps_alone": len(table.did) - step,
        "push_first": pushed.actions - step,
        "cleared": [table.ended == "cleared", pushed.ended == "cleared"],
    }


LIMITS = (0.0, 1.0, 1.5, 2.0, 2.2, 2.4, 2.6, 3.0)
"""Shortfalls from which on pushes are made, in the table."""


def table(states: dict[str, Any]) -> str:
    """Return a table of what pushes save in all, by the shortfall or the rise of the mean from which they are made."""
    rows = {name: states[name] for name in KINDS}
    lines = [["states", *map(_about, rows.values())]]
    for limit in LIMITS:
        cells = [_saved([row for row in found if row["shortfall"] > limit]) for found in rows.values()]
        lines.append([f"shortfall over {limit:.1f}", *cells])
    for ratio in (1 / 0.9, 2.0, 3.0, 4.0):
        cells = [_saved([row for row in found if (row["mean_ratio"] or 0) > ratio]) for found in rows.values()]
        lines.append([f"mean score rises by a factor over {ratio:.2f}", *cells])
    return markdown.table(["pushed where", *(f"{name}: pushes; saved; only with, only without" for name in rows)], lines)


def _saved(rows: Sequence[dict[str, Any]]) -> str:
    """Return the number of pushes, actions saved where both ways cleared, and tables that one way alone cleared."""
    made = [row for row in rows if row["pushed"]]
    saved = sum(row["grasps_alone"] - row["push_first"] for row in made if all(row["cleared"]))
    alone, pushed = (sum(row["cleared"] == way for row in made) for way in ([True, False], [False, True]))
    return f"{len(made)}; {saved:+d}; {pushed}, {alone}"


def _about(rows: Sequence[dict[str, Any]]) -> str:
    """Return the number of states, of cases, of single objects, and of tables that were cleared in both ways."""
    cases = len({row["case"] for row in rows})
    single = sum(row["objects"] == 1 for row in rows)
    both, neither = (sum(row["cleared"] == [way, way] for row in rows) for way in (True, False))
    return f"{len(rows)} of {cases} cases, {single} with a single object; both ways cleared {both}, neither {neither}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.push_or_grasp", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("results/push-or-grasp"))
    parser.add_argument("--page", action="store_true", help="put what is in --out into docs; run nothing")
    options = parser.parse_args(arguments)

    def work() -> int:
        path = options.out / "states.json"
        if not options.page:
            console.require_out(options.out)
            engine = make_engine("native")
            rows: dict[str, Any] = {name: compare(engine, tables, options.out / name) for name, tables in KINDS.items()}
            files.write_json(path, rows | {pages.MADE: pages.made_here(SEED)})
            console.say(table(rows))
            return 0
        rows = files.read_json(path)
        files.write_json(pages.DOCS / "push-or-grasp.json", rows)
        page = pages.DOCS / "clearing.md"
        files.write_text(page, pages.with_table(files.read_text(page), table(rows)))
        return 0

    return console.exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
