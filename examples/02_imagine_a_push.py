"""What would the camera see after a push? The image that DIPN predicts, and the one after the simulated push."""

import jax
import numpy as np

import dipn_jax
from dipn_jax.planning import candidates, predictors
from dipn_jax.sight import masks
from dipn_jax.world import primitives

# the second hard table, at rest: four blocks side by side and one apart
names, scenes, poses = dipn_jax.load_cases()
engine = dipn_jax.make_engine("native")
scene = scenes[1:2]  # a batch of one
rest = np.asarray(primitives.settle(engine, scene, poses[1:2]).poses)[:, -1]
observation = dipn_jax.render(scene[0], rest[0])

# four pushes of 10 cm, and how DIPN thinks that each moves every object: [4, N, 3] metres, metres, radians
pushes, feasible = candidates.sample_pushes(jax.random.key(3), observation, count=4, distance=0.1)
predict = jax.jit(predictors.load_predictor("builtin"))
motion = predict(observation, pushes)

# the first push: every object's pixels moved, against the simulation
centers, area = masks.mask_centers(observation.label, observation.slots)
predicted = dipn_jax.imagine(observation, centers, motion[0])
rollout = primitives.push(engine, scene, rest, pushes[:1])
after = dipn_jax.render(scene[0], np.asarray(rollout.poses)[0, -1])


def iou(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean IoU of the objects' masks in two label maps."""
    pairs = [(one == slot, other == slot) for slot in range(5)]
    return float(np.mean([(a & b).sum() / (a | b).sum() for a, b in pairs]))


imagined, nothing_moves = iou(predicted.label, after.label), iou(observation.label, after.label)
print(f"overlap with what happened: predicted {imagined:.2f}, if nothing had moved {nothing_moves:.2f}")
