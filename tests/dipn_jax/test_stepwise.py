import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dipn_jax import candidates, checkpoint, clutter, geometry, policy, primitives, render, structs
from dipn_jax.networks import push_frame, stepwise
from dipn_jax.workspace import GRIPPER


def test_outlines_are_how_far_the_pixels_reach(settled: Any) -> None:
    height, label = render.render_depth(structs.take(settled.scene, 0), settled.poses[0])
    centers, _ = candidates.mask_centers(label, 5)
    got = np.asarray(push_frame.outlines(label, height, jnp.float32(0.4), centers))
    at = (np.arange(224) - 111.5) * 0.002
    c, s = np.cos(0.4), np.sin(0.4)
    normals = push_frame.directions() @ np.array([[c, s], [-s, c]])
    for i in range(5):
        for which, mask in enumerate((label == i, (label == i) & (height > GRIPPER.push_tip))):
            rows, cols = np.nonzero(np.asarray(mask))
            points = np.stack([at[cols], at[rows]], -1) - np.asarray(centers[i])
            want = (points @ normals.T).max(0) if len(points) else np.zeros(push_frame.DIRECTIONS)
            np.testing.assert_allclose(got[i, :, which], want, atol=1e-5)


def _box(half: tuple[float, float], angle: float) -> np.ndarray:
    """Support function of a box about its middle."""
    c, s = np.cos(angle), np.sin(angle)
    own = push_frame.directions() @ np.array([[c, -s], [s, c]])  # directions as the box sees them
    return (np.abs(own) @ np.array(half)).astype(np.float32)


def test_turning_an_outline_turns_the_object() -> None:
    got = stepwise.turn(jnp.asarray(_box((0.05, 0.02), 0.0))[:, None], jnp.float32(0.5))[:, 0]
    np.testing.assert_allclose(got, _box((0.05, 0.02), 0.5), atol=1e-3)


def test_the_largest_gap_is_the_distance() -> None:
    first, second = _box((0.05, 0.02), 0.0), _box((0.01, 0.03), 0.0)
    apart = np.asarray(stepwise.gaps(jnp.array([0.1, 0.0]), jnp.asarray(first), jnp.asarray(second)))
    np.testing.assert_allclose(apart.max(), 0.1 - 0.05 - 0.01, atol=1e-6)
    assert apart.argmax() == 0, "the direction from one to the other"
    touching = stepwise.gaps(jnp.array([0.0, -0.05]), jnp.asarray(first), jnp.asarray(second))
    np.testing.assert_allclose(touching.max(), 0.0, atol=1e-6)


def test_the_builtin_network_knows_what_a_push_does(settled: Any, engine: Any) -> None:
    """On three scenes of five objects, against the engine: far better than to say that nothing moves."""
    scene, poses = structs.take(settled.scene, slice(0, 3)), settled.poses[:3]
    seen = clutter.observe(scene, poses)
    sample = jax.vmap(lambda key, one: candidates.sample_pushes(key, one, count=1, slots=5, distance=0.1))
    pushes, feasible = sample(jax.random.split(jax.random.key(0), 3), seen)
    pushes = jax.tree.map(lambda leaf: np.asarray(leaf)[:, 0], pushes)
    assert feasible.all()
    network: Any = checkpoint.load_network(pathlib.Path("builtin"), network="dipn")
    distances = np.tile(np.array([0.05, 0.1], np.float32), (3, 1))
    told = policy.dipn_motions(network, seen, pushes, distances, slots=5)
    rolled = np.asarray(primitives.push(engine, scene, poses, pushes).poses)
    centers = jax.vmap(lambda label: candidates.mask_centers(label, 5)[0])(seen.label)
    true = geometry.planar_motion(rolled[:, :1], rolled[:, [5, 10]], centers[:, None])
    moved = np.linalg.norm(true[..., :2], axis=-1) > 0.01
    error = np.linalg.norm((told - true)[..., :2], axis=-1)
    assert moved.sum() >= 4
    assert error[moved].mean() < 0.25 * np.linalg.norm(true[..., :2], axis=-1)[moved].mean()


def test_the_builtin_network_names_no_folder_of_the_machine_that_made_it() -> None:
    texts = [path.read_bytes() for path in checkpoint.find(pathlib.Path("builtin"), network="dipn").rglob("*.txt")]
    assert texts and not any(b" /" in text for text in texts)
