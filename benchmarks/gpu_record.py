"""The file of `on_gpu`: what was measured, how each stage ended, and on which machines."""

from __future__ import annotations

import dataclasses
import pathlib
import platform
from typing import Any

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.system import files, machine, typed

MEASURED = "measured"
"""See `gpu_stage.MEASURED`, whose import would import JAX."""


@dataclasses.dataclass(frozen=True)
class Stage:
    """A stage as the table names it."""

    what: str
    place: str  # module:function
    seconds: float  # that it may take, of ten minutes
    is_check: bool = False  # whether its failure is the command's
    goal: str = ""


KEPT = {
    "figures": {str: float},
    "notes": {str: str},
    "stages": {str: {"state": str, "seconds": float, "compiling": float, "machine": typed.Whole()}},
    "machine": [{"rows": str, "scale": str, "seed": typed.Whole()}],
}
"""The form of the file."""


class Record:
    """The file: figures, lines of text, how each stage ended, and on which machines."""

    def __init__(self, path: pathlib.Path, *, scale: str, seed: int) -> None:
        """Read what an earlier run has left in the file.

        Raises:
          UserError: it is something else, or of another scale or seed.
        """
        self.path, self.setting = path, {"seed": seed, "scale": scale}
        self.kept: dict[str, Any] = {"figures": {}, "notes": {}, "stages": {}, "machine": []}
        if path.exists():
            self.kept = files.read_json(path, wanted=KEPT)
            for facts in self.kept["machine"]:
                for name, value in self.setting.items():
                    if facts[name] != value:
                        raise UserError(
                            f"{path}: begun with {name} {facts[name]}, asked for {value}; give another --out"
                        )

    def is_measured(self, stage: str) -> bool:
        """Return whether all of a stage is in the file."""
        return bool(self.kept["stages"].get(stage, {}).get("state") == MEASURED)

    def forget(self, stage: str) -> None:
        """Remove the figures and lines of a stage, which is measured again."""
        for part in ("figures", "notes"):
            old = self.kept[part]
            self.kept[part] = {name: old[name] for name in old if name != stage and not name.startswith(f"{stage}/")}
        self.kept["stages"].pop(stage, None)

    def note(self, answer: dict[str, Any]) -> None:
        """Record a figure or a line of text, and print it."""
        if "figure" in answer:
            self.kept["figures"][answer["figure"]] = answer["value"]
            console.say(f"{answer['figure']} {answer['value']:.4g}")
        else:
            self.kept["notes"][answer["note"]] = answer["text"]
            console.say(f"{answer['note']} {answer['text']}")

    def end(self, stage: str, state: str, *, seconds: float, compiling: float, facts: dict[str, Any]) -> None:
        """Note how a stage ended, and write the file.

        Args:
          stage: its name.
          state: how it ended.
          seconds: that it took.
          compiling: seconds of them in which something was compiled.
          facts: `gpu_stage.facts`, or nothing where its process did not come so far.
        """
        if state != MEASURED and not state.startswith("partly"):
            self.kept["notes"][stage] = state
        facts = (facts or _without_device()) | self.setting
        known = [{name: old[name] for name in old if name != "rows"} for old in self.kept["machine"]]
        if facts not in known:
            self.kept["machine"].append(facts)
            known.append(facts)
        self.kept["stages"][stage] = {
            "state": state,
            "seconds": round(seconds, 2),
            "compiling": round(compiling, 2),
            "machine": known.index(facts),
        }
        for number, place in enumerate(self.kept["machine"]):
            named = [name for name, entry in self.kept["stages"].items() if entry["machine"] == number]
            place["rows"] = ", ".join(named) or "none"
        files.write_json(self.path, self.kept)

    def table(self, stages: dict[str, Stage]) -> str:
        """Return one line per stage: main figure, goal, how it ended, seconds, and the seconds spent compiling."""
        lines = [f"{'stage':32} {'value':>9} {'goal':>8} {'s':>6} {'compiling':>9}  ended"]
        for name, stage in stages.items():
            entry = self.kept["stages"].get(name, {"state": "not measured", "seconds": 0.0, "compiling": 0.0})
            value = self.kept["figures"].get(name)
            shown = "" if value is None else f"{value:.4g}"
            times = f"{entry['seconds']:6.1f} {entry['compiling']:9.1f}"
            lines.append(f"{name:32} {shown:>9} {stage.goal:>8} {times}  {entry['state']}")
        return "\n".join(lines)


def _without_device() -> dict[str, Any]:
    """Return what is known of a machine without asking its accelerator."""
    return {
        "processor": machine.processor(),
        "cores": machine.cores(),
        "devices": [],
        "python": platform.python_version(),
        "versions": files.package_versions(),
        "commit": machine.commit(),
    }
