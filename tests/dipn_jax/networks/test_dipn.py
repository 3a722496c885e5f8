import functools
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from dipn_jax import geometry, structs
from dipn_jax.networks import dipn, losses, push_frame
from dipn_jax.networks.push_frame import COMPACT, PAPER, PushInput
from dipn_jax.sight import render
from dipn_jax.structs import ABSENT, Push

SLOTS = 5
DISTANCES = np.tile(np.array([0.03, 0.05, 0.1], np.float32), (6, 1))


@pytest.fixture(scope="module")
def network() -> dipn.DIPN:
    model = dipn.DIPN(dipn.DipnConfig(), rngs=nnx.Rngs(0))
    model.eval()
    return model


@pytest.fixture(scope="module")
def forward(network: dipn.DIPN) -> Any:
    graph, state = nnx.split(network)
    compiled = jax.jit(lambda inputs, distances: nnx.merge(graph, state)(inputs, distances))
    return lambda inputs, distances=DISTANCES: compiled(inputs, distances)


def _push(x: float = -0.1, y: float = 0.02, angle: float = 0.4, distance: float = 0.05) -> Push:
    return Push(jnp.array([x, y]), jnp.float32(angle), jnp.float32(distance))


@pytest.fixture(scope="module")
def inputs(settled: Any) -> PushInput:
    heights, labels = jax.vmap(render.render_depth)(settled.scene, jnp.asarray(settled.poses))
    pushes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (6, *leaf.shape)), _push())
    return push_frame.push_inputs(labels, heights, pushes, slots=SLOTS, view=COMPACT)[0]


def test_the_push_starts_at_pixel_40_112_and_goes_to_plus_x() -> None:
    # a mark at the start and one 40 mm ahead along the push
    push = _push()
    ahead = push.start + 0.04 * jnp.array([jnp.cos(push.angle), jnp.sin(push.angle)])
    label = np.full((224, 224), ABSENT)
    for i, point in enumerate((push.start, ahead)):
        col, row = np.round(np.asarray(geometry.metres_to_pixels(point))).astype(int)
        label[row - 1 : row + 2, col - 1 : col + 2] = i
    made, _ = push_frame.push_input(jnp.array(label), jnp.zeros((224, 224)), push, slots=2, view=PAPER)
    rows, cols = np.nonzero(np.asarray(made.scene_map))
    first = cols < 50
    np.testing.assert_allclose([cols[first].mean(), rows[first].mean()], push_frame.START_PIXEL, atol=0.8)
    np.testing.assert_allclose([cols[~first].mean(), rows[~first].mean()], [60, 112], atol=0.8)
    np.testing.assert_allclose(made.centers[1], [0.04, 0.0], atol=2e-3)
    box = np.asarray(made.push_map)
    assert box[100:125, 40:66].all() and box.sum() == 25 * 26


@pytest.mark.parametrize("view", [PAPER, COMPACT])
def test_crops_are_opencvs_warp(settled: Any, view: push_frame.View) -> None:
    # the turn into the push frame about the object's own centre, every `stride` pixels
    height, label = render.render_depth(structs.take(settled.scene, 0), settled.poses[0])
    made, centers = push_frame.push_input(label, height, _push(), slots=SLOTS, view=view)
    c, s = view.stride * np.cos(0.4), view.stride * np.sin(0.4)
    rotation = np.array([[c, -s], [s, c]])
    side = view.crop_side
    for i in range(SLOTS):
        offset = np.asarray(geometry.metres_to_pixels(centers[i])) - rotation @ np.full(2, (side - 1) / 2)
        own = (np.asarray(label) == i).astype(np.uint8)
        warp = np.column_stack([rotation, offset])
        want = cv2.warpAffine(own, warp, (side, side), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
        assert want.any() and (np.asarray(made.crops[i, ..., 0]) == want).mean() > 0.98


def test_the_push_frame_is_opencvs_warp(settled: Any) -> None:
    height, label = render.render_depth(structs.take(settled.scene, 0), settled.poses[0])
    push = _push()
    made, _ = push_frame.push_input(label, height, push, slots=SLOTS, view=PAPER)
    c, s = np.cos(0.4), np.sin(0.4)
    rotation = np.array([[c, -s], [s, c]])
    offset = np.asarray(geometry.metres_to_pixels(push.start)) - rotation @ np.array(push_frame.START_PIXEL)
    warp = np.column_stack([rotation, offset])
    mask = (np.asarray(label) >= 0).astype(np.uint8)
    want = cv2.warpAffine(mask, warp, (224, 224), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
    assert (np.asarray(made.scene_map) == want).mean() > 0.995


def test_crops_are_centred_on_their_own_object(inputs: PushInput) -> None:
    own = np.asarray(inputs.crops[..., 0])
    rows, cols = np.mgrid[:16, :16]
    for b in range(6):
        for i in range(SLOTS):
            if own[b, i].sum() > 20:
                assert abs((own[b, i] * rows).sum() / own[b, i].sum() - 7.5) < 0.8
                assert abs((own[b, i] * cols).sum() / own[b, i].sum() - 7.5) < 0.8
    assert (inputs.crops[..., 0] * inputs.crops[..., 1]).sum() == 0


def test_motion_round_trips_between_frames() -> None:
    motion = jnp.array([[0.01, -0.02, 0.3]])
    back = push_frame.to_workspace(push_frame.from_workspace(motion, jnp.float32(0.7)), jnp.float32(0.7))
    np.testing.assert_allclose(back, motion, atol=1e-6)
    # along the push is +x of the push frame
    along = 0.01 * jnp.array([[jnp.cos(0.7), jnp.sin(0.7), 0.0]])
    np.testing.assert_allclose(push_frame.from_workspace(along, jnp.float32(0.7)), [[5.0, 0.0, 0.0]], atol=1e-4)


def test_permuting_objects_permutes_the_output(forward: Any, inputs: PushInput) -> None:
    order = np.array([3, 1, 4, 0, 2])
    mixed = inputs.replace(
        crops=inputs.crops[:, order],
        outlines=inputs.outlines[:, order],
        centers=inputs.centers[:, order],
        present=inputs.present[:, order],
    )
    np.testing.assert_allclose(forward(mixed), forward(inputs)[:, order], atol=1e-4)


def test_objects_out_of_sight_change_nothing(forward: Any, inputs: PushInput) -> None:
    hidden = inputs.replace(present=inputs.present.at[:, 3:].set(False))
    other = hidden.replace(
        crops=hidden.crops.at[:, 3:].set(1.0),
        centers=hidden.centers.at[:, 3:].set(0.3),
        outlines=hidden.outlines.at[:, 3:].set(0.1),
    )
    out = forward(hidden)
    np.testing.assert_array_equal(out, forward(other))
    np.testing.assert_array_equal(out[:, 3:], 0.0)


def test_batch_elements_do_not_interact(forward: Any, inputs: PushInput) -> None:
    changed = jax.tree.map(lambda leaf: leaf.at[0].set(jnp.zeros_like(leaf[0])), inputs)
    np.testing.assert_allclose(forward(changed)[1:], forward(inputs)[1:], atol=1e-5)


@pytest.mark.slow
def test_the_published_form_does_not_depend_on_order_padding_and_neighbours(settled: Any) -> None:
    network = dipn.DIPN(dipn.DipnConfig(preset="paper", stages=(1, 1, 1, 1)), rngs=nnx.Rngs(0))
    network.eval()
    graph, state = nnx.split(network)
    forward = jax.jit(lambda seen: nnx.merge(graph, state)(seen, jnp.full((2, 1), 0.05)))
    two = structs.take(settled.scene, slice(0, 2))
    heights, labels = jax.vmap(render.render_depth)(two, jnp.asarray(settled.poses[:2]))
    pushes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (2, *leaf.shape)), _push())
    seen = push_frame.push_inputs(labels, heights, pushes, slots=SLOTS, view=PAPER)[0]
    there = forward(seen)
    assert np.abs(there).max() > 1e-3
    order = np.array([3, 1, 4, 0, 2])
    each = ("crops", "outlines", "centers", "present")
    mixed = seen.replace(**{name: getattr(seen, name)[:, order] for name in each})
    np.testing.assert_allclose(forward(mixed), there[:, order], atol=1e-4)
    wide = push_frame.push_inputs(labels, heights, pushes, slots=SLOTS + 2, view=PAPER)[0]
    np.testing.assert_allclose(forward(wide)[:, :SLOTS], there, atol=1e-4)
    changed = jax.tree.map(lambda leaf: leaf.at[0].set(jnp.zeros_like(leaf[0])), seen)
    np.testing.assert_allclose(forward(changed)[1], there[1], atol=1e-5)


@pytest.mark.parametrize("view", [PAPER, COMPACT])
def test_the_mirror_of_an_input_is_the_input_of_the_mirror(view: push_frame.View, settled: Any) -> None:
    # a push along +x through the middle of the map: mirroring the scene is flipping the map's rows
    height, label = render.render_depth(structs.take(settled.scene, 0), settled.poses[0])
    push = _push(x=-0.143, y=0.0, angle=0.0)
    make = functools.partial(push_frame.push_input, slots=SLOTS, view=view)
    direct = push_frame.mirror(jax.tree.map(lambda leaf: leaf[None], make(label, height, push)[0]))
    flipped = make(jnp.flip(label, 0), jnp.flip(height, 0), push)[0]
    mirrored = jax.tree.map(lambda leaf: leaf[None], flipped)
    names = ("push_map", "scene_map", "crops") if view is PAPER else ("crops",)
    np.testing.assert_allclose(direct.outlines, mirrored.outlines, atol=1e-4)
    for name in names:
        a, b = getattr(direct, name), getattr(mirrored, name)
        assert np.mean(np.abs(np.asarray(a) - np.asarray(b)) > 0.05) < 0.02, name
    np.testing.assert_allclose(direct.centers, mirrored.centers, atol=1e-3)


def test_the_mirror_of_a_push_has_the_mirrored_outcome(network: dipn.DIPN, inputs: PushInput) -> None:
    graph, state = nnx.split(network)
    answer = jax.jit(lambda seen: dipn.symmetric(nnx.merge(graph, state), seen, DISTANCES))
    there = answer(inputs)
    assert np.abs(there).max() > 1e-3
    np.testing.assert_allclose(answer(push_frame.mirror(inputs)), push_frame.mirror_motion(there), atol=1e-4)


def test_the_prediction_at_a_distance_does_not_depend_on_the_other_distances(forward: Any, inputs: PushInput) -> None:
    several = forward(inputs)
    reversed_ = forward(inputs, DISTANCES[:, ::-1])
    np.testing.assert_allclose(several, reversed_[:, :, ::-1], atol=1e-5)
    assert np.abs(forward(inputs, np.zeros_like(DISTANCES))).max() == 0, "a push of no length moves nothing"
    ends = forward(inputs, np.tile(np.array([0.09, 0.10, 0.12], np.float32), (6, 1)))
    beyond = ends[:, :, 1] + 2 * (ends[:, :, 1] - ends[:, :, 0])
    np.testing.assert_allclose(ends[:, :, 2], beyond, atol=1e-3)  # past 10 cm as in the last centimetre
    halfway = forward(inputs, np.tile(np.array([0.04, 0.05, 0.045], np.float32), (6, 1)))
    np.testing.assert_allclose(halfway[:, :, 2], halfway[:, :, :2].mean(2), atol=1e-4)


@pytest.mark.slow
def test_paper_dipn_takes_a_training_step(settled: Any, one_step: Any) -> None:
    model = dipn.DIPN(dipn.DipnConfig(preset="paper", stages=(1, 1, 1, 1)), rngs=nnx.Rngs(0))
    height, label = render.render_depth(structs.take(settled.scene, 0), settled.poses[0])
    made, _ = push_frame.push_input(label, height, _push(), slots=SLOTS, view=PAPER)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), made)
    target, distances = jnp.ones((2, SLOTS, 1, 3)), jnp.array([[0.05], [0.1]])
    mask = batch.present[..., None]
    before, after = one_step(model, lambda m: losses.motion_loss(m(batch, distances), target, mask))
    assert np.isfinite(before) and after < before
