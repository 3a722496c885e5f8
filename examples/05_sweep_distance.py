"""The same push over twelve distances in one compiled call: distance is an argument, not part of the program."""

import jax
import jax.numpy as jnp
import numpy as np

import dipn_jax
from dipn_jax.planning import candidates, predictors

names, scenes, poses = dipn_jax.load_cases()
observation = dipn_jax.render(scenes[1], poses[1])
predict = predictors.load_predictor("builtin")
pushes, feasible = candidates.sample_pushes(jax.random.key(0), observation, count=4, distance=0.1)
push = pushes[0]


@jax.jit
def travel(distance: jax.Array) -> jax.Array:
    """Return by how many metres each object would move, `[N]`."""
    motion = predict(observation, push.replace(distance=distance)[None])
    return jnp.linalg.norm(motion[0, :, :2], axis=-1)


distances = jnp.arange(1, 13) * 0.01
moved = np.asarray(jax.vmap(travel)(distances))  # [12, N]
for distance, each in zip(distances, moved, strict=True):
    print(f"push of {100 * distance:2.0f} cm: objects move by", np.round(1000 * each).astype(int), "mm")
