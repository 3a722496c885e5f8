"""The renderer against MuJoCo's ray caster on the same images of the same scenes."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import mujoco
import numpy as np
from mujoco import batch as mujoco_batch

from benchmarks.harness import Setting, alternate
from dipn_jax import structs
from dipn_jax.engine import PhysicsConfig
from dipn_jax.physics import cores, make_engine
from dipn_jax.sight import render
from dipn_jax.structs import ABSENT, Observation, Scene, SettledScene
from dipn_jax.workspace import WORKSPACE
from dipn_jax.world import clutter, model, scenes

OBJECTS = 10
"""Number of objects in a scene."""
BATCH = 16
"""Number of scenes."""
CAMERA_HEIGHT = 1.0
"""Height in metres above the table from which rays start."""
GRIPPER_HEIGHT = 3.0
"""Height in metres to which the gripper is lifted out of the view."""
LABELS_EQUAL = 0.999
"""Smallest share of pixels on which both must agree for their times to be compared."""


class RayCaster:
    """The images by MuJoCo: RGB, height and labels by one vertical ray per pixel.

    `mj_multiRay` sends all rays from one point, so an orthographic view needs `Batch.ray`, which spreads scenes
    over all cores.
    """

    def __init__(self, items: SettledScene) -> None:
        """Everything that can be made ready before the rays."""
        texts = [model.mjcf(structs.take(items.scene, i), config=PhysicsConfig(), alike=True)
                 for i in range(len(items.fault))]  # fmt: skip
        models = [mujoco.MjModel.from_xml_string(text) for text in texts]
        self.sims = mujoco_batch.Batch(models[0], nsim=len(models), nthread=cores())
        self.sims.set_models(models)
        self.sims.qpos[:, 2] = GRIPPER_HEIGHT
        self.sims.qpos[:, model.GRIPPER_DOF :] = np.asarray(items.poses).reshape(len(models), -1)
        self.slot = models[0].geom_bodyid - models[0].body("o0").id  # of each geom; negative: no object
        at = (np.arange(WORKSPACE.pixels) - (WORKSPACE.pixels - 1) / 2) * WORKSPACE.pixel
        x, y = np.meshgrid(at, at)
        self.origin = np.stack([x, y, np.full_like(x, CAMERA_HEIGHT)], -1).reshape(-1, 3)
        table = np.broadcast_to(render.TABLE_COLOR, (len(models), 1, 3))
        self.palette = np.concatenate([np.asarray(items.scene.color), table], 1)

    def observe(self) -> Observation:
        """Return observations as `render.observe` does, as NumPy arrays."""
        side = WORKSPACE.pixels
        distance, geom = self.sims.ray(self.origin, np.array([0.0, 0.0, -1.0]))
        slot = np.where(geom < 0, ABSENT, self.slot[geom])
        label = np.where(slot < 0, ABSENT, slot).reshape(-1, side, side)
        height = np.where(label < 0, 0.0, CAMERA_HEIGHT - distance.reshape(label.shape))
        color = self.palette[np.arange(len(label))[:, None, None], label]  # ABSENT is the last: the table
        slots = self.palette.shape[1] - 1
        return Observation(height.astype(np.float32), color.astype(np.float32), label.astype(np.int32), slots)


def _same(ours: Observation, theirs: Observation) -> None:
    equal = float((np.asarray(ours.label) == theirs.label).mean())
    if equal < LABELS_EQUAL:
        raise RuntimeError(f"labels of renderer and ray caster agree on {equal:.4f} of all pixels: not the same images")


def vs_raycast(setting: Setting) -> Iterator[tuple[str, float]]:
    """Measure seconds of the ray caster over seconds of the renderer."""
    mine, theirs = times(setting.seed, BATCH, repeats=setting.pick(5, 15))
    yield "render.vs_raycast", theirs / mine


def times(seed: int, batch: int, *, repeats: int) -> tuple[float, float]:
    """Measure seconds of the renderer and of the ray caster for images of `batch` scenes."""
    key = jax.random.key(seed)
    items = clutter.settled_scenes(key, make_engine("native"), scenes.fixed_count(OBJECTS), batch)
    caster = RayCaster(items)
    scene: Scene = jax.tree.map(jax.numpy.asarray, items.scene)
    poses = jax.numpy.asarray(items.poses)
    _same(render.observe(scene, poses), caster.observe())  # also compiles
    inner = 10  # images take a thousandth of a second each

    def ours() -> None:
        for _ in range(inner):
            jax.block_until_ready(render.observe(scene, poses))

    mine, theirs = alternate(ours, caster.observe, repeats=repeats)
    return mine / inner, theirs
