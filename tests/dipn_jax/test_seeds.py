"""No scene is drawn twice: not by two commands, and not by two parts of one."""

import functools
import pathlib
import re
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
from dipn_jax.datagen import check, generate
from dipn_jax.eval.clearing import sweeping
from dipn_jax.eval.clearing.tables import Tables
from dipn_jax.eval.grasping import success
from dipn_jax.eval.prediction import push_errors
from dipn_jax.train.online import baseline
from dipn_jax.train.online import grasping as online

from dipn_jax import seeds
from dipn_jax.commands import console
from dipn_jax.networks.grasp import GraspConfig
from dipn_jax.storage import checkpoint, resume
from dipn_jax.world import clutter, scenes

CONFIG = scenes.parse_objects("3")
"""The scenes that every command draws here."""
EACH = 4
"""Scenes compared of each command."""
SEED = 5
"""The seed of every command here."""


class _Enough(Exception):
    """The first scenes of a command are drawn."""


def _datagen(kind: str, index: int, engine: Any) -> None:
    job = generate.Job(kind=kind, scene=CONFIG, episodes=32, seed=SEED, shard_size=8, actions=1, engine="native")
    with console.Progress(kind, 8, unit="episodes") as progress:
        generate.shard(job, index, engine, generate._Tally(progress))


def _commands(engine: Any, out: pathlib.Path) -> dict[str, Callable[[], Any]]:
    """Return, by name, what draws scenes in each command, at one seed."""
    network = GraspConfig(width=8, coarse=8, blocks=1)
    nothing: Any = None  # a network that is not reached
    checks = check._sections(check.CheckConfig((), scenes=EACH, few=EACH, tries=1, seed=SEED), {}, 1)
    partial = resume.Partial(out / "partial", {})
    count = {"scenes": EACH, "seed": SEED}
    return {
        **{f"{kind} {i}": functools.partial(_datagen, kind, i, engine) for kind in generate.PURPOSES for i in (0, 1)},
        **{f"check-world {name}": checks[name] for name in ("drops", "pushes", "camera")},
        "grasp-online": lambda: online.learn(
            checkpoint.build("grasp", network), engine, CONFIG, online.OnlineConfig(tables=EACH, seed=SEED), out / "a"
        ),
        "baseline": lambda: baseline.learn(
            engine, CONFIG, baseline.BaselineConfig("rea", tables=EACH, seed=SEED), out / "b"
        ),
        "prediction": lambda: push_errors.measured(
            {}, engine, CONFIG, partial, **count, physics=False, segmented=False
        ),
        "grasp": lambda: success.tried(nothing, engine, CONFIG, partial, **count),
        "grasp, single objects": lambda: success.labels_tried(engine, CONFIG, **count),
        "clear": lambda: Tables("random", objects="3", instances=EACH).make(engine, seed=SEED),
        "sweep": lambda: sweeping.measured(nothing, engine, CONFIG, (0.1,), **count, longest=0.1),
    }


def test_no_two_commands_draw_the_same_scene(
    engine: Any, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []

    def settled(key: jax.Array, _: Any, __: scenes.SceneConfig, count: int) -> Any:
        drawn.append(clutter._random_scenes(jax.random.split(key, count)[:EACH], CONFIG))
        raise _Enough

    monkeypatch.setattr(clutter, "settled", settled)
    whose: dict[bytes, str] = {}
    commands = _commands(engine, tmp_path)
    for name, draw in commands.items():
        with pytest.raises(_Enough):
            draw()
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(drawn[-1])]
        for i in range(EACH):
            scene = b"".join(leaf[i].tobytes() for leaf in leaves)
            assert scene not in whose, f"{name} draws a scene of {whose[scene]}"
            whose[scene] = name
    assert len(whose) == EACH * len(commands)


def test_every_purpose_has_a_number_of_its_own() -> None:
    """An alias, another name of the same number, is in `__members__` alone."""
    assert len(seeds.Purpose) == len(seeds.Purpose.__members__) > 10
    first, other = (seeds.key(SEED, purpose) for purpose in list(seeds.Purpose)[:2])
    assert (jax.random.key_data(first) != jax.random.key_data(other)).any()


def test_commands_take_their_keys_from_here() -> None:
    """Two commands that each made a key of the seed alone would share it; keys of a constant draw no scenes."""
    root = pathlib.Path(__file__).parents[2]
    paths = [path for stage in ("datagen", "train", "eval") for path in (root / stage).rglob("*.py")]
    assert len(paths) > 30
    assert [path for path in paths if re.search(r"random\.key\((?!\d)", path.read_text())] == []
