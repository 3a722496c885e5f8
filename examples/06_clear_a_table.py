"""Clear a table: look, decide, simulate, until nothing is left."""

import jax
import numpy as np

import dipn_jax
from dipn_jax.world import clutter, primitives

names, scenes, poses = dipn_jax.load_cases()
engine = dipn_jax.make_engine("native")
policy = dipn_jax.load_policy("dipn+gn")

scene = scenes[9:10]  # the last hard table, as a batch of one: engines simulate batches
state = np.asarray(primitives.settle(engine, scene, poses[9:10]).poses)[:, -1]
key, actions = jax.random.key(0), []
memory = dipn_jax.MissedGrasps()

while (scene.shape >= 0).any() and len(actions) < 12:
    observation = dipn_jax.render(scene[0], state[0])
    memory = memory.recall(observation.height)  # forgets grasps around which something has moved
    decision = policy(jax.random.fold_in(key, len(actions)), observation, missed=memory.pixels())
    if decision.is_push:
        rollout = primitives.push(engine, scene, state, decision.push[None])
        state = np.asarray(rollout.poses)[:, -1]
        actions.append("push")
    else:
        scene, state, held, fault = clutter.grasp_away(engine, scene, state, decision.grasp[None])
        actions.append("grasp" if held.any() else "miss")
        if not held.any():
            memory = memory.add(decision.grasp_pixel, observation.height)
    print(f"{len(actions)}. {actions[-1]} (best score {decision.grasp_score:.2f}): {(scene.shape >= 0).sum()} left")
