"""The experiment of docs/mjx-elliptic-cone.md: why MJX's elliptic cones fail in float32.

    python -m experiments.mjx_elliptic_cone

Three minutes on 2 cores; it writes the page's table. MJX 3.17.0, float32, elliptic cone, Newton: `_LSPoint.create` has
tsqr = uu + alpha * (2 * uv + alpha * vv), the squared tangential residual of a contact along the step. Where the
residual vanishes (a Newton step into sticking, alpha near 1) float32 makes it a little negative; its square root is
NaN, `dm * nmt` is NaN even where dm = 0, and so the point's cost. `jp.where(lo.cost < hi.cost, ...)` then returns the
NaN end of the bracket. Clamping the root's argument is all that this script changes.
"""

from __future__ import annotations

import argparse
import pathlib
import types
from collections.abc import Callable
from typing import Any

import jax
import mujoco
import numpy as np
from jax import numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import solver

from dipn_jax.commands import markdown
from experiments import pages

BOXES = 6
"""Number of boxes in a pile."""
SCENES = 32
"""Number of piles."""
STEPS = 400
"""Number of time steps."""
SEED = 0
"""Seed of the piles."""
FASTEST_FALL = 2.8
"""Speed in m/s that no box can exceed by falling: the highest begins 0.4 m above the plane."""
_BODY = '<body><freejoint/><geom type="box" size=".02 .015 .025" density="500"/></body>'
MJCF = f"""<mujoco><option timestep=".0025" integrator="implicitfast" cone="elliptic" impratio="10" iterations="50"
 ls_iterations="50" jacobian="dense"/><custom><numeric name="max_contact_points" data="60"/></custom>
<default><geom solref=".01 1" friction=".5 .005 .0001"/></default>
<worldbody><geom type="plane" size="0 0 1"/>{_BODY * BOXES}</worldbody></mujoco>"""
"""A model of plain boxes on a plane."""

ROOTS = {"mjx as it is": jnp.sqrt, "mjx, sqrt(max(x, 0))": lambda x: jnp.sqrt(jnp.maximum(x, 0.0))}
"""Square roots that the solver is run with."""
C = "MuJoCo C"
"""Name of the reference."""


def starts() -> np.ndarray:
    """Return poses of the boxes above the plane: `[SCENES, BOXES, 7]`, metres and unit quaternions."""
    rng = np.random.default_rng(SEED)
    start = np.zeros((SCENES, BOXES, 7), np.float32)
    start[..., :2] = rng.uniform(-0.03, 0.03, (SCENES, BOXES, 2))
    start[..., 2] = 0.05 + 0.07 * np.arange(BOXES)
    start[..., 3:] = rng.normal(size=(SCENES, BOXES, 4))
    start[..., 3:] /= np.linalg.norm(start[..., 3:], axis=-1, keepdims=True)
    return start


def peaks_mjx(spec: mujoco.MjModel, start: np.ndarray) -> np.ndarray:
    """Return the highest speed of a box in each scene, by MJX: `[SCENES]` m/s."""
    model = mjx.put_model(spec)

    def rollout(qpos: jax.Array) -> jax.Array:
        def step(d: Any, _: None) -> tuple[Any, jax.Array]:
            d = mjx.step(model, d)
            return d, jnp.linalg.norm(d.qvel.reshape(BOXES, 6)[:, :3], axis=-1).max()

        return jax.lax.scan(step, mjx.make_data(model).replace(qpos=qpos), None, length=STEPS)[1].max()

    return np.asarray(jax.jit(jax.vmap(rollout))(start.reshape(SCENES, -1)))


def peak_c(spec: mujoco.MjModel, qpos: np.ndarray) -> float:
    """Return the highest speed of a box in one scene, by MuJoCo C: m/s."""
    data, top = mujoco.MjData(spec), 0.0
    data.qpos[:] = qpos.ravel()
    for _ in range(STEPS):
        mujoco.mj_step(spec, data)
        top = max(top, np.linalg.norm(data.qvel.reshape(BOXES, 6)[:, :3], axis=-1).max())
    return top


def measure() -> dict[str, Any]:
    """Return the figures of `MEASURES`, of the highest speed of a box in each scene, by name: solver/measure."""
    spec, start = mujoco.MjModel.from_xml_string(MJCF), starts()
    found: dict[str, np.ndarray] = {}
    for name, root in ROOTS.items():
        solver.jp = types.SimpleNamespace(**{**vars(jnp), "sqrt": root})
        found[name] = peaks_mjx(spec, start)
    found[C] = np.array([peak_c(spec, q) for q in start])
    return {f"{name}/{key}": figure(speeds) for name, speeds in found.items() for key, (_, figure) in MEASURES.items()}


MEASURES: dict[str, tuple[str, Callable[[np.ndarray], float]]] = {
    "not_a_number": ("not a number", lambda speeds: int((~np.isfinite(speeds)).sum())),
    "impossible": (f"above {FASTEST_FALL} m/s", lambda speeds: int((speeds > FASTEST_FALL).sum())),
    "median": ("median, m/s", lambda speeds: round(float(np.nanmedian(speeds)), 2)),
    "largest": ("largest, m/s", lambda speeds: round(float(np.nanmax(speeds)), 2)),
}
"""Figures of speeds `[SCENES]`, with their titles; the last two leave out those that are no number."""


def table(values: dict[str, Any]) -> str:
    """Return the page's table of what `measure` returns."""
    rows = [[name, *(str(values[f"{name}/{key}"]) for key in MEASURES)] for name in (*ROOTS, C)]
    return markdown.table(["solver", *(title for title, _ in MEASURES.values())], rows)


def write_page(values: dict[str, Any], *, docs: pathlib.Path = pages.DOCS) -> None:
    """Write what `measure` returned, with its table and box, to the page in the folder `docs`."""
    made = {"piles": pages.made_here(SEED)}
    pages.write("mjx-elliptic-cone", values | {pages.MADE: made}, [table(values)], docs=docs)


def main() -> None:
    """Run the experiment and write its page."""
    argparse.ArgumentParser(prog="python -m experiments.mjx_elliptic_cone", description=__doc__).parse_args()
    write_page(measure())


if __name__ == "__main__":
    main()
