"""MJX 3.17.0, float32, elliptic cone, Newton: a line-search point costs NaN and the solver takes a step that goes up.

`_LSPoint.create` has tsqr = uu + alpha * (2 * uv + alpha * vv): the squared tangential residual of a contact along the
step. Where the residual vanishes (a Newton step into sticking, alpha near 1) float32 makes it a little negative; its
square root is NaN, `dm * nmt` is NaN even where dm = 0, and so the point's cost. `jp.where(lo.cost < hi.cost, ...)`
then returns the NaN end of the bracket. Clamping the root's argument is all that this script changes.
"""

import types

import jax
import mujoco
import numpy as np
from jax import numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import solver

BOXES, SCENES, STEPS = 6, 32, 400
rng = np.random.default_rng(0)
body = '<body><freejoint/><geom type="box" size=".02 .015 .025" density="500"/></body>'
xml = f"""<mujoco><option timestep=".0025" integrator="implicitfast" cone="elliptic" impratio="10" iterations="50"
 ls_iterations="50" jacobian="dense"/><custom><numeric name="max_contact_points" data="60"/></custom>
<default><geom solref=".01 1" friction=".5 .005 .0001"/></default>
<worldbody><geom type="plane" size="0 0 1"/>{body * BOXES}</worldbody></mujoco>"""
spec = mujoco.MjModel.from_xml_string(xml)
start = np.zeros((SCENES, BOXES, 7), np.float32)
start[..., :2] = rng.uniform(-0.03, 0.03, (SCENES, BOXES, 2))
start[..., 2] = 0.05 + 0.07 * np.arange(BOXES)
start[..., 3:] = rng.normal(size=(SCENES, BOXES, 4))
start[..., 3:] /= np.linalg.norm(start[..., 3:], axis=-1, keepdims=True)


def peaks_mjx() -> np.ndarray:
    model = mjx.put_model(spec)

    def rollout(qpos: jax.Array) -> jax.Array:
        def step(d, _):
            d = mjx.step(model, d)
            return d, jnp.linalg.norm(d.qvel.reshape(BOXES, 6)[:, :3], axis=-1).max()

        return jax.lax.scan(step, mjx.make_data(model).replace(qpos=qpos), None, length=STEPS)[1].max()

    return np.asarray(jax.jit(jax.vmap(rollout))(start.reshape(SCENES, -1)))


def peak_c(qpos: np.ndarray) -> float:
    data, top = mujoco.MjData(spec), 0.0
    data.qpos[:] = qpos.ravel()
    for _ in range(STEPS):
        mujoco.mj_step(spec, data)
        top = max(top, np.linalg.norm(data.qvel.reshape(BOXES, 6)[:, :3], axis=-1).max())
    return top


for name, root in (("mjx as it is", jnp.sqrt), ("mjx, sqrt(max(x, 0))", lambda x: jnp.sqrt(jnp.maximum(x, 0.0)))):
    solver.jp = types.SimpleNamespace(**{**vars(jnp), "sqrt": root})
    print(f"{name}: highest speed of each scene, m/s", np.sort(peaks_mjx())[::-1].round(2)[:12])
print("mujoco C:", np.sort([peak_c(q) for q in start])[::-1].round(2)[:12])
