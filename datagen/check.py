"""`dipn-datagen check-world`: the figures of `world`, section by section, and the page that shows them."""

from __future__ import annotations

import dataclasses
import functools
import json
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dipn_jax import batching, seeds
from dipn_jax.commands import console, markdown
from dipn_jax.engine import Engine
from dipn_jax.errors import UserError
from dipn_jax.physics import make_engine
from dipn_jax.seeds import Purpose
from dipn_jax.storage import owner
from dipn_jax.structs import Fault
from dipn_jax.system import files, typed
from dipn_jax.world import shapes

from . import world

CAMERA_SCENES = 50
"""Scenes that the camera is compared on."""


@dataclasses.dataclass(frozen=True)
class CheckConfig:
    """Amount of what is measured."""

    engines: tuple[str, ...]
    scenes: int
    few: int  # scenes for warp, which is slow on a CPU, and drops for mjx (on a GPU for warp, too)
    tries: int
    seed: int

    def __post_init__(self) -> None:
        unknown = [name for name in self.engines if name not in world.ENGINES]
        if unknown:
            raise UserError(f"--engines {' '.join(unknown)}: want some of {' '.join(world.ENGINES)}")
        console.require_between(1, batching.BATCH // 2, scenes=self.scenes, few=self.few)
        console.require_between(1, 1000, tries=self.tries)
        console.require_seed(self.seed)


def run(out: pathlib.Path, config: CheckConfig, *, threads: int | None = None) -> None:
    """Measure, and write `metrics.json` and `world.md`; sections already measured with this config are not repeated.

    Raises:
      UserError: an engine cannot run here, the folder belongs to another config, or another process has it.
    """
    console.require_out(out)
    with owner.owned(out):
        _measure(out, config, threads)


def _measure(out: pathlib.Path, config: CheckConfig, threads: int | None) -> None:
    """Measure in a folder that this process owns; arguments as of `run`."""
    engines = {}
    for name in config.engines:
        variant = world.ENGINES[name]
        engines[name] = make_engine(variant.engine, timestep=variant.timestep, sleep=variant.sleep, threads=threads)
    code = {"versions": files.package_versions(), "code": files.code_digest(pathlib.Path(__file__).parent)}
    settings = json.loads(json.dumps(dataclasses.asdict(config))) | code
    files.claim(out, settings, free=("engines",))
    sections = _sections(config, engines, threads)
    metrics: dict[str, float | None] = {}
    with console.Progress("check-world", len(sections), unit="sections") as progress:
        for name, measure in sections.items():
            path = out / "sections" / f"{name}.json"
            if not path.exists():
                files.write_json(path, {k: v if np.isfinite(v) else None for k, v in measure().items()})
            progress.advance(1, name)
    for path in sorted((out / "sections").glob("*.json")):  # also those of engines of earlier runs
        metrics.update(files.read_json(path, wanted={str: typed.Maybe(float)}))
    files.write_json(out / "settings.json", settings)
    files.write_json(out / "metrics.json", metrics)
    files.write_text(out / "world.md", page(metrics))
    console.say(page(metrics))


def _sections(
    config: CheckConfig, engines: dict[str, Engine], threads: int | None
) -> dict[str, Callable[[], dict[str, float]]]:
    """Return the functions that measure each section, by name."""
    native = make_engine("native", threads=threads)
    keys = jax.random.split(seeds.key(config.seed, Purpose.WORLD_CHECK), 3)

    @functools.cache
    def reference() -> tuple[world.Trial, dict[str, float], np.ndarray, np.ndarray]:
        made = world.trial(keys[1], native, config.scenes)
        found, poses = world.pushes(native, made)
        return made, found, poses, world.held_by(native, made)

    def agree(name: str, engine: Engine) -> dict[str, float]:
        made, _, poses, held = reference()
        count = min(config.few, config.scenes) if name == "warp" else config.scenes
        return world.agreement(name, engine, made.first(count), poses[:count], held[:count])

    def crowds(name: str, engine: Engine) -> dict[str, float]:
        return world.drops(keys[0], engine, config.few, name=f"drop-{name}", counts=world.CROWDED_COUNTS)

    def may_crowd(engine: Engine) -> bool:
        """Return whether an engine is fast enough here; MuJoCo Warp would take hours on a CPU."""
        return engine.name == "mjx" or (engine.name == "warp" and jax.default_backend() != "cpu")

    return {
        "drops": lambda: world.drops(keys[0], native, batching.BATCH),
        **{f"drops-{name}": lambda name=name, e=e: crowds(name, e) for name, e in engines.items() if may_crowd(e)},  # type: ignore[misc]
        "grasps": lambda: world.isolated_grasps(native, config.seed, config.tries),
        "pushes": lambda: reference()[1],
        "sweep": lambda: world.sweep(native, reference()[0], reference()[2]),
        "camera": lambda: world.camera(keys[2], native, CAMERA_SCENES),
        **{
            f"rest-{name}": lambda name=name, e=e: world.rests(name, e, config.seed)  # type: ignore[misc]
            for name, e in {"native": native, **engines}.items()
        },
        **{f"agreement-{name}": lambda name=name, e=e: agree(name, e) for name, e in engines.items()},  # type: ignore[misc]
    }


class _Cells:
    """Figures as text for tables; empty where one is missing."""

    def __init__(self, metrics: dict[str, Any]) -> None:
        self.metrics = metrics

    def share(self, key: str) -> str:
        value = self.metrics.get(key)
        return "" if value is None else f"{100 * value:.0f} %"

    def number(self, key: str, form: str) -> str:
        value = self.metrics.get(key)
        return "" if value is None else format(value, form)

    def pair(self, key: str, unit: str) -> str:
        return " / ".join(self.number(f"{key}/{q}_{unit}", ".2f") for q in ("p50", "p90"))


def page(metrics: dict[str, Any]) -> str:
    """Return the figures as Markdown."""
    cells = _Cells(metrics)
    parts = [
        *_drop_parts(cells),
        *_grasp_parts(cells),
        *_push_parts(cells),
        *_camera_parts(cells),
        *_engine_parts(cells),
    ]
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def _drop_parts(cells: _Cells) -> list[str]:
    columns = ["kept", "outside", "unsettled", "speed", "penetration", "capacity", "non_finite"]
    drops = [
        [name, str(n), cells.number(f"{key}/{n}/tries", ".0f"), *(cells.share(f"{key}/{n}/{c}") for c in columns)]
        for name, key in [("native", "drop"), *((name, f"drop-{name}") for name in world.ENGINES)]
        for n in world.DROPPED_COUNTS
        if f"{key}/{n}/kept" in cells.metrics
    ]
    rests = [
        [
            name,
            cells.number(f"rest/{name}/tries", ".0f"),
            cells.share(f"rest/{name}/at_rest"),
            cells.share(f"rest/{name}/as_put"),
            cells.number(f"rest/{name}/turn_max_deg", ".2f"),
            cells.number(f"rest/{name}/from_table_max_mm", ".3f"),
        ]
        for name in ("native", *world.ENGINES)
        if f"rest/{name}/tries" in cells.metrics
    ]
    return [
        "## Drops",
        markdown.table(["engine", "objects", "tries", *columns], drops),
        "## Every catalogue item set down on every face that it can stand on",
        markdown.table(
            ["engine", "tries", "at rest", "as put", "largest turn, degrees", "farthest from the table, mm"], rests
        ),
    ]


def _grasp_parts(cells: _Cells) -> list[str]:
    rows = [
        [i.name, cells.share(f"grasp_isolated/{i.name}"), cells.number(f"grasp_isolated_tries/{i.name}", ".0f")]
        for i in shapes.CATALOGUE
    ]
    return [
        "## Grasps of single objects, centred and antipodal, off by up to 1 cm and 7.5 degrees",
        markdown.table(["item", "held", "tries"], rows),
        f"Closing on the 100 mm side: {cells.share('grasp_too_wide/held')} held; one finger on top of an object of "
        f"2 kg: {cells.share('grasp_on_top/held')}; the same object, centred: {cells.share('grasp_heavy/held')}.",
    ]


def _push_parts(cells: _Cells) -> list[str]:
    pushed = [[name, cells.share(f"push/{name}")] for name in ("tipped_of_moved", *Fault.NAMES.values())]
    sweeps = [[f"{k} cm", cells.pair(f"sweep/{k}cm", "mm"), cells.pair(f"sweep/{k}cm", "deg")] for k in (3, 5, 7)]
    return [
        f"## Pushes of 10 cm, {cells.number('push/moved_objects', '.0f')} objects moved",
        markdown.table(["what", "share"], pushed),
        f"Deepest contact at any centimetre, gripper included: {cells.number('push/depth_max_mm', '.2f')} mm.",
        "## A push of its own against the same centimetre of a longer one p50 / p90",
        markdown.table(["after", "mm", "degrees"], sweeps),
    ]


def _camera_parts(cells: _Cells) -> list[str]:
    return [
        "## Camera against MuJoCo's ray caster",
        f"{cells.number('camera/scenes', '.0f')} scenes of ten objects: labels equal on "
        f"{cells.number('camera/labels_equal', '.4%').replace('%', ' %')} of pixels; heights there within 0.1 mm "
        f"but for {cells.number('camera/heights_apart', '.0f')} on edges (largest\n"
        f"{cells.number('camera/height_max_mm', '.2f')} mm).",
    ]


def _engine_parts(cells: _Cells) -> list[str]:
    rows = [
        [name, cells.number(f"agreement/{name}/scenes", ".0f")]
        + [cells.pair(f"agreement/{name}/{at}", unit) for at in ("1cm", "5cm", "10cm") for unit in ("mm", "deg")]
        + [cells.number(f"agreement/{name}/{key}", ".0f") for key in ("grasps", "grasps_that_held")]
        + [cells.share(f"agreement/{name}/grasp"), cells.share(f"agreement/{name}/unsettled")]
        for name in world.ENGINES
        if f"agreement/{name}/grasp" in cells.metrics
    ]
    columns = [f"{c} cm, {u}" for c in (1, 5, 10) for u in ("mm", "deg")]
    return [
        "## Engines against `native` at 2 ms, objects that it moves: p50 / p90",
        markdown.table(["engine", "scenes", *columns, "grasps", "of them held", "equal", "unsettled"], rows),
    ]
