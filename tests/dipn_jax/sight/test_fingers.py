import jax.numpy as jnp
import numpy as np
from flax import nnx

from dipn_jax.networks import grasp
from dipn_jax.sight import fingers


def test_geometric_labels_of_a_bar() -> None:
    # a bar 50 mm wide across the closing direction can be grasped at its middle, not from its end
    height = jnp.zeros((160, 160)).at[40:120, 68:93].set(0.05)
    labels = fingers.geometric_labels(height)
    assert labels[80, 80] == 1
    assert labels[80, 40] == 0, "no object there"
    turned = fingers.geometric_labels(height.T)
    assert turned[80, 80] == 0, "the fingers would land on the bar"
    crowded = fingers.geometric_labels(height.at[:, 102:112].set(0.05))
    assert crowded[80, 80] == 0, "a finger would land on the neighbour"


def test_a_finger_that_would_land_on_something_tall_blocks_the_grasp() -> None:
    # a cube in the middle, and 38 to 56 mm to the right of its centre a wall: over a fingertip at 20 mm by 30, or by 15
    cube = jnp.zeros((224, 224)).at[100:125, 100:125].set(0.05)
    tall, low = (cube.at[60:164, 131:140].set(high) for high in (0.05, 0.035))
    blocked = np.asarray(fingers.blocked_image(tall))
    assert blocked.shape == (16, 224, 224)
    assert blocked[[0, 8], 112, 112].all() and not blocked[[4, 12], 112, 112].any()
    assert not np.asarray(fingers.blocked_image(low))[:, 112, 112].any()
    high = jnp.zeros((224, 224)).at[100:125, 100:125].set(0.08).at[60:164, 131:140].set(0.055)
    assert not np.asarray(fingers.blocked_image(high))[:, 112, 112].any()  # the tips go to 40 mm
    cut = np.asarray(fingers.blocked_image(jnp.zeros((224, 224)).at[100:125, 195:].set(0.03)))
    assert cut[0, 112, 205] and not cut[0, 112, 190] and not cut[4, 112, 205]  # one finger would be out of sight
    assert cut[0, 140, 205] and not cut[0, 150, 205]  # 22 mm and 42 mm beside what is seen of it, a pad's half less
    inside = np.asarray(fingers.blocked_image(jnp.zeros((224, 224)).at[100:125, 190:218].set(0.03)))
    assert not inside[0, 112].any()
    model = grasp.GraspNet(grasp.GraspConfig(width=8, coarse=8, blocks=1), rngs=nnx.Rngs(0))
    model.eval()
    images = [jnp.zeros((224, 224, 4)).at[..., 3].set(height) for height in (tall, low)]
    scores = [np.asarray(nnx.jit(grasp.aided_scores)(model, image)) for image in images]
    for image, cautious in zip(images, scores, strict=True):
        plain = np.asarray(nnx.jit(grasp.score_image)(model, image))
        assert (cautious <= plain + 1e-5).mean() > 0.999
    assert 0 < scores[0][0, 112, 112] <= 0.5 < scores[0][0, 112, 112] / scores[1][0, 112, 112] * 1.5
