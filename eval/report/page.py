"""The report: one HTML file with its pictures inside, and the numbers of several evaluations in one `metrics.json`."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

from dipn_jax.commands import pages
from dipn_jax.errors import UserError
from dipn_jax.storage import arrays
from dipn_jax.system import files, typed

from .. import drawing, metrics
from ..clearing import sweeping
from . import comparison, networks, results, tabular
from .cleared import Cleared

_FILMS = {
    "before": arrays.Form("fu", ("pushes", "H", "W", 3)),
    "predicted": arrays.Form("fu", ("pushes", "H", "W", 3)),
    "after": arrays.Form("fu", ("pushes", "H", "W", 3)),
    "push": arrays.Form("f", ("pushes", 4)),
}
"""Arrays of the pictures of predictions."""


@dataclasses.dataclass(frozen=True)
class Sources:
    """The folders that a report is made from."""

    prediction: pathlib.Path | None = None  # of dipn-eval prediction
    grasp: pathlib.Path | None = None  # of dipn-eval grasp
    clears: Sequence[pathlib.Path] = ()  # of dipn-eval clear
    sweep: pathlib.Path | None = None  # of dipn-eval sweep
    runs: Sequence[pathlib.Path] = ()  # of dipn-train


def write(out: pathlib.Path, sources: Sources, *, against: str = "") -> dict[str, Any]:
    """Write `report.html`, its pictures and `metrics.json` to a folder; return the metrics of all sources.

    Where tables were cleared, their results are in `table.md` and `table.csv`, too.

    Args:
      out: the folder.
      sources: what the report is made from.
      against: the row of cleared tables that the others are compared with, as `results.grouped` takes it.

    Raises:
      UserError: there are no sources, a folder lacks what its command writes, or no row is called `against`.
    """
    if against and not sources.clears:
        raise UserError(f"--against {against}: compares cleared tables; give their folders with --clear")
    values, parts, figures, texts = _sections(sources, against)
    if not parts:
        raise UserError("report: nothing to report; give --prediction, --grasp, --clear, --sweep or --runs")
    body = "".join(parts)
    for name, figure in figures.items():
        body = body.replace(f"{{{name}}}", drawing.image(figure, out / "pictures" / f"{name}.png"))
    versions = ", ".join(f"{k} {v}" for k, v in files.package_versions().items())
    body = f'<h1>Push or grasp?</h1>{body}<p class="note">Made with {pages.escaped(versions)}.</p>'
    page = pages.standalone_page("dipn-jax report", body)
    files.write_text(out / "report.html", page)
    for name, text in texts.items():
        files.write_text(out / name, text)
    files.write_json(out / "metrics.json", values)
    return values


def _sections(sources: Sources, against: str) -> tuple[dict[str, Any], list[str], dict[str, Any], dict[str, str]]:
    """Return the metrics, the sections as HTML with places for figures, and by name the figures and other files."""
    values: dict[str, Any] = {}
    parts: list[str] = []
    figures: dict[str, Any] = {}
    texts: dict[str, str] = {}
    try:
        if sources.clears:
            cleared = [Cleared(folder) for folder in sources.clears]
            values |= comparison.flat(cleared)
            found = results.grouped(cleared, against=against)
            values |= results.differences(found)
            part, more = comparison.section(found)
            parts.append(part)
            figures |= more
            texts = {"table.md": tabular.as_markdown(found), "table.csv": tabular.as_csv(found)}
        if sources.sweep:
            values |= metrics.read(sources.sweep)
            figures["sweep"] = sweeping.figure(values)
            parts.append(f"<h2>Push distance</h2>{sweeping.table(values)}{{sweep}}")
        if sources.prediction:
            values |= metrics.read(sources.prediction)
            figures["prediction"] = _prediction_film(_load(sources.prediction / "films.npz"))
            parts.append(_prediction_section(values))
        if sources.grasp:
            values |= metrics.read(sources.grasp)
            parts.append(_grasp_section(values))
        if evaluated := _evaluated(sources):
            parts.append(f"<h2>Networks</h2>{networks.table(evaluated)}")
        if sources.runs:
            figures["curves"] = _curves(sources.runs)
            parts.append("<h2>Learning curves</h2>{curves}")
    except (LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise UserError(
            f"report: a folder lacks {typed.brief(str(error))}; give the folders that dipn-eval wrote"
        ) from None
    return values, parts, figures, texts


def _evaluated(sources: Sources) -> dict[pathlib.Path, str]:
    """Return the folders of evaluations, each with the name of what was evaluated."""
    single = {"sweep": sources.sweep, "prediction": sources.prediction, "grasp": sources.grasp}
    found = dict.fromkeys(sources.clears, "clear")
    return found | {folder: name for name, folder in single.items() if folder is not None}


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _prediction_section(values: dict[str, Any]) -> str:
    rows = []
    for name in ("dipn", "static", "trans", "physics"):
        if f"push_error/{name}/5cm/all" not in values:
            continue
        cells = [
            _figure(values.get(f"{measure}/{name}/{distance}/{which}"))
            for measure in ("push_error", "push_error_paper_measure")
            for distance in ("5cm", "10cm")
            for which in ("all", "moved")
        ]
        rows.append([name, *cells])
    head = ["", *[f"{m} {d} {w}" for m in ("1-IoU", "XOR/2") for d in ("5 cm", "10 cm") for w in ("all", "moved")]]
    return (
        f"<h2>Predicting a push</h2><p>{values['pushes']} held-out pushes, {values['objects']} objects in sight, "
        f"{values['objects_moved/5cm']} moved after 5 cm.</p>{pages.table(head, rows)}{{prediction}}"
    )


def _grasp_section(values: dict[str, Any]) -> str:
    rows = [[name, drawing.percent(values, f"grasp_success/{name}")] for name in ("gn", "random_foreground")]
    return (
        f"<h2>Grasping</h2><p>{values['attempts']} grasps by GN until {values['scenes']} tables were empty, and "
        f"a random one on each; expected calibration error {values['expected_calibration_error']:.3f}.</p>"
        f"{pages.table(['', 'success %'], rows)}"
    )


def _load(path: pathlib.Path) -> Any:
    try:
        return arrays.read(path, _FILMS)
    except typed.Misfit as error:
        raise UserError(f"{path}: {error}; run the dipn-eval command that writes it again") from None


def _prediction_film(films: Any) -> Any:
    count = min(comparison.FILM_ROWS, len(films["before"]))
    figure, axes = plt.subplots(count, 3, figsize=(7.5, 2.5 * count), squeeze=False)
    for row in range(count):
        drawing.show(axes[row, 0], films["before"][row], "before, push" if row == 0 else "")
        drawing.arrow(axes[row, 0], films["push"][row])
        drawing.show(axes[row, 1], films["predicted"][row], "predicted" if row == 0 else "")
        drawing.show(axes[row, 2], films["after"][row], "after" if row == 0 else "")
    return figure


def _curves(runs: Sequence[pathlib.Path]) -> Any:
    figure, axes = plt.subplots(1, len(runs), figsize=(4 * len(runs), 3), squeeze=False)
    for axis, run in zip(axes[0], runs, strict=True):
        lines = files.read_lines(run / "metrics.jsonl", wanted={str: float})
        for key in dict.fromkeys(k for line in lines for k in line if k != "step"):
            some = [line for line in lines if key in line]
            axis.plot(
                [line["step"] for line in some], [line[key] for line in some], marker=".", label=drawing.label(key)
            )
        axis.set(title=drawing.label(run.name), xlabel="steps", yscale="log")
        axis.legend(fontsize=7)
        axis.grid(alpha=0.3)
    return figure
