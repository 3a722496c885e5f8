"""The page of a data set: what it holds, how often each value was drawn, and pictures of a sample to filter."""

from __future__ import annotations

import collections
import json
import pathlib
import shlex
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from dipn_jax import structs
from dipn_jax.commands import console, pages
from dipn_jax.sight import render
from dipn_jax.storage import accounting, records, shards
from dipn_jax.structs import ABSENT, Fault
from dipn_jax.system import addresses, files, typed
from dipn_jax.workspace import WORKSPACE
from dipn_jax.world import shapes

SHOWN_AS_MOVED_DISTANCE = 0.001
"""Metres by which an object is farther than before that counts as moved."""
STEP = 2
"""Every second pixel of a view is shown."""
Counts = dict[str, collections.Counter[str]]
_STYLE = """.bar{width:12em}.bar i{display:block;height:.8em;background:#48a}section{display:inline-block;
vertical-align:top;margin-right:2em}figure{display:inline-block;margin:.3em;width:232px;vertical-align:top}
figure div{position:relative;display:inline-block;width:112px;height:112px}figure img{width:112px;height:112px;
image-rendering:pixelated}figure svg{position:absolute;left:0;top:0;width:112px;height:112px}
figcaption{font-size:12px;line-height:1.3;color:#444}label{margin-right:1.5em}[hidden]{display:none!important}"""
_SCRIPT = """const selects=[...document.querySelectorAll('select')],figures=[...document.querySelectorAll('figure')];
function sift(){let shown=0;for(const f of figures){f.hidden=!selects.every(s=>s.value===''||
f.dataset[s.name].split(' ').includes(s.value));shown+=!f.hidden}
document.getElementById('shown').textContent=shown}
selects.forEach(s=>s.addEventListener('change',sift));sift()"""


def write(folder: pathlib.Path, page: pathlib.Path, *, sample: int, seed: int) -> None:
    """Write the page of a data set.

    Args:
      folder: the data set.
      page: file to write.
      sample: number of episodes that are shown, drawn at random.
      seed: of that draw.

    Raises:
      UserError: the data set is missing or damaged.
    """
    about = records.summary(folder)
    count = int(about["episodes"])
    rng = np.random.default_rng(seed)
    shown = np.sort(rng.choice(count, min(sample, count), replace=False))
    counts: Counts = collections.defaultdict(collections.Counter)
    figures: list[str] = []
    first = 0
    with console.Progress("look", count, unit="episodes") as progress:
        for path in shards.shard_files(folder):
            episodes = shards.read_shard(path, kind=about["kind"])
            size = len(episodes.fault)
            _count(episodes, counts)
            mine = shown[(shown >= first) & (shown < first + size)]
            if len(mine):
                figures += _figures(structs.take(episodes, mine - first), mine)
            first += size
            progress.advance(size, path.name)
    files.write_text(page, _page(folder, about, counts, figures))


def _tags(episodes: Any) -> list[dict[str, list[str]]]:
    """Return what each episode can be filtered by: faults, shapes, distance, outcome."""
    present = np.asarray(episodes.scene.shape) != ABSENT
    found = []
    for row, fault in enumerate(np.asarray(episodes.fault)):
        names = [name for bit, name in Fault.NAMES.items() if fault & bit] or ["none"]
        classes = sorted({int(one) for one in episodes.scene.shape[row][present[row]]})
        tags = {"fault": names, "shape": [shapes.CLASSES[one] for one in classes]}
        if hasattr(episodes, "push"):
            before, after = episodes.poses[row, 0, :, :3], episodes.after[row, :, :3]
            number = int((np.linalg.norm(after - before, axis=-1)[present[row]] > SHOWN_AS_MOVED_DISTANCE).sum())
            tags["distance"] = [f"{100 * float(episodes.push.distance[row]):.3g}cm"]
            tags["outcome"] = [f"{number}-moved"]
        if hasattr(episodes, "grasp"):
            tags["outcome"] = [f"{int(episodes.held[row].sum())}-held"]
        found.append(tags)
    return found


def _count(episodes: Any, counts: Counts) -> None:
    """Add episodes `[B]` to the counts of drawn values."""
    scene = episodes.scene
    present = np.asarray(scene.shape) != ABSENT
    counts["objects on the table"].update(f"{number:3d}" for number in present.sum(-1))
    counts["objects by shape"].update(shapes.CLASSES[one] for one in np.asarray(scene.shape)[present])
    longest = np.floor(100 * np.asarray(scene.size)[present].max(-1)).astype(int)
    counts["objects by longest side"].update(f"{one:3d} to {one + 1} cm" for one in longest)
    for tags in _tags(episodes):
        for name, values in tags.items():
            if name != "shape":
                counts[f"episodes by {name}"].update(values)


def _figures(episodes: Any, numbers: np.ndarray) -> list[str]:
    """Return a figure for each of the episodes `[B]`: before, after, the action, and what it can be filtered by."""
    before = episodes.poses[:, 0] if episodes.poses.ndim == 4 else episodes.poses
    views = [_views(episodes.scene, before)]
    if hasattr(episodes, "after"):
        views.append(_views(episodes.scene, episodes.after))
    found = []
    for row, (tags, number) in enumerate(zip(_tags(episodes), numbers, strict=True)):
        data = " ".join(f'data-{name}="{pages.escaped(" ".join(values))}"' for name, values in tags.items())
        said = "; ".join(" ".join(values) for name, values in tags.items() if name != "shape")
        drawn = "".join(
            f"<div>{pages.picture(view[row], f'episode {number}')}{_action(episodes, row) if not at else ''}</div> "
            for at, view in enumerate(views)
        )
        found.append(f"<figure {data}>{drawn}<figcaption>{number}: {pages.escaped(said)}</figcaption></figure>")
    return found


def _views(scene: Any, poses: np.ndarray) -> list[bytes]:
    """Return what the camera sees of scenes `[B, N]` at poses `[B, N, 7]`, as PNG with y up."""
    color = np.rint(255 * np.asarray(render.observe(scene, poses).color)).astype(np.uint8)
    return [cv2.imencode(".png", one[::-STEP, ::STEP, ::-1])[1].tobytes() for one in color]


def _action(episodes: Any, row: int) -> str:
    """Return the action of an episode as a drawing to be laid over the view before it."""
    half = WORKSPACE.half
    lines: list[tuple[np.ndarray, np.ndarray]] = []
    if hasattr(episodes, "push"):
        push = episodes.push
        along = np.array([np.cos(push.angle[row]), np.sin(push.angle[row])])
        end = push.start[row] + push.distance[row] * along
        across = np.array([-along[1], along[0]])
        lines = [(push.start[row], end)] + [(end, end - 0.02 * along + side * 0.012 * across) for side in (-1, 1)]
    elif hasattr(episodes, "grasp"):
        grasp = episodes.grasp
        along = np.array([np.cos(grasp.angle[row]), np.sin(grasp.angle[row])])
        across = 0.012 * np.array([-along[1], along[0]])
        centers = [grasp.center[row] + side * 0.047 * along for side in (-1, 1)]
        lines = [(center - across, center + across) for center in centers]
    drawn = "".join(f"M{a[0]:.4f} {-a[1]:.4f}L{b[0]:.4f} {-b[1]:.4f}" for a, b in lines)
    box = f"{-half} {-half} {2 * half} {2 * half}"
    return f'<svg viewBox="{box}"><path d="{drawn}" stroke="#fff" stroke-width=".006" fill="none"/></svg>'


def _page(folder: pathlib.Path, about: dict[str, Any], counts: Counts, figures: list[str]) -> str:
    """Return the page as HTML."""
    title = f"{folder.name}: {about['episodes']} {about['kind']} episodes"
    facts = [
        ["episodes", f"{about['episodes']}" + (f" of {about['asked']} asked for" if about["asked"] else "")],
        ["shards", str(about["shards"])],
        ["bytes", f"{about['bytes']:,}"],
        *[[f"while it was made: {name}", str(number)] for name, number in about["faults"].items() if number],
    ]
    tables = "".join(pages.bars(name, dict(sorted(some.items()))) for name, some in counts.items())
    parts = [
        f"<h1>{pages.escaped(title)}</h1><p>{pages.escaped(addresses.with_urls(str(folder)))}</p>",
        *[f'<p class="note">{pages.escaped(said)}</p>' for said in _remarks(about)],
        f"<h2>Counts</h2>{pages.table(['', ''], facts)}<h2>What was drawn</h2>{tables}",
        f"<h2>Episodes</h2><p>{_selects(counts)}<span id=shown>{len(figures)}</span> of {len(figures)} shown, drawn at "
        "random: before and after the action.</p>",
        "".join(figures),
        "<h2>How it was made</h2>",
        *_made(folder, about),
    ]
    return pages.standalone_page(title, "".join(parts), style=_STYLE, script=_SCRIPT)


def _remarks(about: dict[str, Any]) -> Iterator[str]:
    for said in (about["missing"], accounting.describe_mixed_makers(about["made_by"])):
        if said:
            yield said


def _selects(counts: Counts) -> str:
    """Return the controls that filter episodes."""
    offered = {name: counts[f"episodes by {name}"] for name in ("fault", "distance", "outcome")}
    offered["shape"] = counts["objects by shape"]
    found = []
    for name, values in offered.items():
        options = "".join(f"<option>{pages.escaped(value)}</option>" for value in sorted(values))
        if values:
            found.append(f'<label>{name} <select name="{name}"><option value="">any</option>{options}</select></label>')
    return "".join(found)


def _made(folder: pathlib.Path, about: dict[str, Any]) -> list[str]:
    command = accounting.command(folder)
    said = [f"<p><code>{pages.escaped(typed.one_line(shlex.join(command), most=4000))}</code></p>"] if command else []
    whole = json.dumps({"config": about["merged"] or about["config"], "made_by": about["made_by"]}, indent=1)
    return [*said, f"<pre>{pages.escaped(whole)}</pre>"]
