"""The report: one HTML file with its pictures inside, and the numbers of several evaluations in one `metrics.json`."""

from __future__ import annotations

import base64
import html
import io
import json
import pathlib
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

from dipn_jax import files
from dipn_jax.errors import UserError
from dipn_jax.workspace import WORKSPACE
from eval import film, metrics

FILM_ROWS = 4
_STYLE = """body{font:16px/1.5 system-ui,sans-serif;max-width:1000px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:1em 0}td,th{padding:.25em .8em;border-bottom:1px solid #ddd;text-align:right}
td:first-child,th:first-child{text-align:left}img{max-width:100%}h2{margin-top:2em}.note{color:#666}"""


def write(
    out: pathlib.Path,
    *,
    prediction: pathlib.Path | None,
    grasp: pathlib.Path | None,
    hard: pathlib.Path | None,
    random: pathlib.Path | None,
    runs: list[pathlib.Path],
) -> dict[str, Any]:
    """Read everything, then write `report.html`, its pictures and `metrics.json`; returns the merged metrics.

    Args:
      out: folder.
      prediction: folder of `dipn-eval prediction`.
      grasp: folder of `dipn-eval grasp`.
      hard: folder of `dipn-eval clear` on hard instances.
      random: folder of `dipn-eval clear` on random instances.
      runs: training runs.

    Raises:
      UserError: a folder lacks what its command writes.
    """
    values: dict[str, Any] = {}
    parts: list[str] = []
    figures: dict[str, Any] = {}
    clears = {name: folder for name, folder in (("hard", hard), ("random", random)) if folder}
    try:
        for name, folder in clears.items():
            values |= {f"clear/{name}/{key}": value for key, value in metrics.read(folder).items()}
        if clears:
            figures |= {f"clear-{name}": _filmstrip(folder) for name, folder in clears.items()}
            parts.append(_clear_section(clears, values))
        if prediction:
            values |= metrics.read(prediction)
            figures["prediction"] = _prediction_film(_load(prediction / "films.npz"))
            parts.append(_prediction_section(values))
        if grasp:
            values |= metrics.read(grasp)
            parts.append(_grasp_section(values))
        if runs:
            figures["curves"] = _curves(runs)
            parts.append("<h2>Learning curves</h2>{curves}")
    except (KeyError, TypeError) as error:
        raise UserError(f"report: a folder lacks {error}; give the folders that dipn-eval wrote") from None
    if not parts:
        raise UserError("report: nothing to report; give --prediction, --grasp, --hard, --random or --runs")
    body = "".join(parts)
    for name, figure in figures.items():
        body = body.replace(f"{{{name}}}", _image(figure, out / "pictures" / f"{name}.png"))
    versions = ", ".join(f"{k} {v}" for k, v in files.package_versions().items())
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>dipn-jax report</title><style>{_STYLE}</style>'
        f'<h1>Push or grasp?</h1>{body}<p class="note">Made with {html.escape(versions)}.</p></html>\n'
    )
    files.write_atomically(out / "report.html", page.encode())
    files.write_json(out / "metrics.json", values)
    return values


def _table(head: list[str], rows: list[list[str]]) -> str:
    def line(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return f"<table>{line(head, 'th')}{''.join(line(row, 'td') for row in rows)}</table>"


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _percent(values: dict[str, Any], key: str) -> str:
    value = values.get(key)
    if value is None or not np.isfinite(value):
        return "-"
    low, high = values.get(f"{key}_low"), values.get(f"{key}_high")
    interval = f" [{100 * low:.0f}, {100 * high:.0f}]" if low is not None and high is not None else ""
    return f"{100 * value:.1f}{interval}"


def _clear_section(clears: dict[str, pathlib.Path], values: dict[str, Any]) -> str:
    columns = ["completion", "grasp_success_completed", "grasp_success_all", "efficiency_completed", "efficiency_all"]
    rows = []
    for name in clears:
        at = f"clear/{name}"
        counts = [str(values[f"{at}/{key}"]) for key in ("instances", "grasps", "pushes")]
        rows.append([name, *counts, *[_percent(values, f"{at}/{key}") for key in columns]])
    head = ["", "tables", "grasps", "pushes", *[f"{c.replace('_', ' ')} %" for c in columns]]
    films = "".join(f"<h3>{name}</h3>{{clear-{name}}}" for name in clears)
    return (
        f"<h2>Clearing tables</h2>{_table(head, rows)}<p>With bootstrap 95 % intervals over tables.</p>"
        "<h2>What was seen, chosen, imagined, and what happened</h2>"
        "<p>Pushes first: the scene with the chosen action; the image predicted for the best push, with the values "
        "compared (gamma times the mean grasp score on it, and the mean score now); the scene after.</p>"
        f"{films}"
    )


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
        f"{values['objects_moved/5cm']} moved after 5 cm.</p>{_table(head, rows)}{{prediction}}"
    )


def _grasp_section(values: dict[str, Any]) -> str:
    rows = [[name, _percent(values, f"grasp_success/{name}")] for name in ("gn", "random_foreground")]
    return (
        f"<h2>Grasping</h2><p>{values['attempts']} grasps by GN until {values['scenes']} tables were empty, and "
        f"a random one on each; expected calibration error {values['expected_calibration_error']:.3f}.</p>"
        f"{_table(['', 'success %'], rows)}"
    )


def _image(figure: Any, path: pathlib.Path) -> str:
    """The figure as an HTML image with its content inside; also kept at `path`."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110, bbox_inches="tight")
    plt.close(figure)
    files.write_atomically(path, stream.getvalue())
    return f'<img alt="{path.stem}" src="data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}">'


def _load(path: pathlib.Path) -> Any:
    try:
        return np.load(path)
    except (OSError, ValueError):
        raise UserError(f"{path}: missing or damaged; run the dipn-eval command that writes it again") from None


def _show(axis: Any, picture: np.ndarray, title: str = "") -> None:
    half = WORKSPACE.half
    axis.imshow(picture, origin="lower", extent=(-half, half, -half, half), interpolation="nearest")
    axis.set(xticks=[], yticks=[], xlim=(-half, half), ylim=(-half, half))
    axis.set_title(title, fontsize=9)


def _arrow(axis: Any, push: np.ndarray) -> None:
    x, y, angle, distance = (float(v) for v in push)
    step = (distance * np.cos(angle), distance * np.sin(angle))
    axis.annotate("", (x + step[0], y + step[1]), (x, y), arrowprops={"arrowstyle": "-|>", "color": "white", "lw": 2.5})


def _jaws(axis: Any, grasp: np.ndarray) -> None:
    angle = grasp[0] * 2 * np.pi / 16
    x, y = ((grasp[[2, 1]] + 0.5) * WORKSPACE.pixel) - WORKSPACE.half
    for side in (-1, 1):
        cx, cy = x + side * 0.047 * np.cos(angle), y + side * 0.047 * np.sin(angle)
        dx, dy = -0.012 * np.sin(angle), 0.012 * np.cos(angle)
        axis.plot([cx - dx, cx + dx], [cy - dy, cy + dy], color="white", lw=3)
    axis.plot([x], [y], "+", color="white")


def _prediction_film(films: Any) -> Any:
    count = min(FILM_ROWS, len(films["before"]))
    figure, axes = plt.subplots(count, 3, figsize=(7.5, 2.5 * count), squeeze=False)
    for row in range(count):
        _show(axes[row, 0], films["before"][row], "before, push" if row == 0 else "")
        _arrow(axes[row, 0], films["push"][row])
        _show(axes[row, 1], films["predicted"][row], "predicted" if row == 0 else "")
        _show(axes[row, 2], films["after"][row], "after" if row == 0 else "")
    return figure


def _filmstrip(folder: pathlib.Path) -> Any:
    """Some steps of the tables of a `dipn-eval clear`: pushes first."""
    steps = []
    for entry in files.read_json(folder / "episodes.json", wanted=list):
        reel = film.load(folder / entry["file"])
        steps += [(entry["name"], i, reel) for i in range(len(reel.what))]
    steps.sort(key=lambda step: (str(step[2].what[step[1]]) != "push", step[1]))
    chosen = steps[:FILM_ROWS]
    figure, axes = plt.subplots(len(chosen), 3, figsize=(7.5, 2.7 * len(chosen)), squeeze=False)
    for row, (name, i, reel) in enumerate(chosen):
        before, predicted, after = reel.pictures(i)
        score, now, push = reel.values[i]
        _show(axes[row, 0], before, f"{name}, action {i + 1}: {reel.what[i]}")
        if reel.what[i] == "push":
            _arrow(axes[row, 0], reel.push[i])
            title = f"predicted: {push:.4f} > {now:.4f}"
        else:
            _jaws(axes[row, 0], reel.grasp[i])
            considered = np.isfinite(push)
            title = (
                f"best push, not taken: {push:.4f} < {now:.4f}" if considered else f"no push; grasp score {score:.2f}"
            )
        _show(axes[row, 1], predicted, title)
        _show(axes[row, 2], after, "what happened")
    return figure


def _curves(runs: list[pathlib.Path]) -> Any:
    figure, axes = plt.subplots(1, len(runs), figsize=(4 * len(runs), 3), squeeze=False)
    for axis, run in zip(axes[0], runs, strict=True):
        try:
            lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        except (OSError, json.JSONDecodeError):
            raise UserError(f"{run}: no readable metrics.jsonl; give the --out of a dipn-train command") from None
        for key in [k for k in (lines[0] if lines else {}) if k != "step"]:
            axis.plot([line["step"] for line in lines], [line[key] for line in lines], marker=".", label=key)
        axis.set(title=run.name, xlabel="steps", yscale="log")
        axis.legend(fontsize=7)
        axis.grid(alpha=0.3)
    return figure
