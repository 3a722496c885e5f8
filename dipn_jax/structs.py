"""The types that are passed between the packages of the project.

Every field states its shape in its annotation (tests check it, see CONTRIBUTING.md), its unit and frame beside it. `*b`
stands for any leading batch axes, added by `jax.vmap` or by the caller; they are the same for all fields of one struct.
`N` is the padded number of object slots, `P` a number of pushes, `S` a number of sampled instants.

Workspace frame: origin at the centre of the workspace on the table's surface, z up, angles from +x
toward +y. Maps are indexed `[row, col]`, row along +y and col along +x.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, Any, Self, TypeAlias, TypeVar

import flax.struct
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

if TYPE_CHECKING:
    Array: TypeAlias = jax.Array | np.ndarray
else:
    Array = jax.Array | np.ndarray | np.generic  # an entry of an np.ndarray is an np.generic
"""A jax.Array on the device, an np.ndarray on the host: every type below serves both."""

T = TypeVar("T")

ABSENT = -1
"""Value of `Scene.shape` in an empty slot."""


class Fault(enum.IntFlag):
    """Bits of a fault code: a simulation that goes wrong returns one and raises nothing.

    In NumPy expressions a member counts as an int64; `int(Fault.SPEED)` takes the type of the array beside it.
    """

    NON_FINITE = 1  # a position or velocity became inf or NaN
    CAPACITY = 2  # the engine ran out of room for contacts or geom pairs
    UNSETTLED = 4  # something still moved when it had to be at rest
    OUTSIDE = 8  # an object's centre is outside the workspace
    SPEED = 16  # an object moved faster than anything dropped or pushed should
    PENETRATION = 32  # an object is in the table, or in another, or was deep in one on the way
    GRIPPER_SHORT = 64  # the gripper did not reach its commanded pose, or left its path on the way
    TIPPED = 128  # a push tipped an object over

    UNUSABLE = NON_FINITE | CAPACITY | SPEED | PENETRATION
    """The simulation went wrong; the other faults are physics (a roll, an object off the table) or the gripper's."""

    NAMES = enum.nonmember(
        {
            1: "non_finite",
            2: "capacity",
            4: "unsettled",
            8: "outside",
            16: "speed",
            32: "penetration",
            64: "gripper_short",
            128: "tipped",
        }
    )
    """What each bit is called in metrics and logs."""

    @classmethod
    def usable(cls, codes: Int[Array, "*_"]) -> Bool[np.ndarray, "*_"]:
        """Return which of the simulations with these fault codes can be used."""
        return (np.asarray(codes) & cls.UNUSABLE) == 0

    @classmethod
    def count(cls, codes: Int[Array, "*_"]) -> dict[str, int]:
        """Return how many of the fault codes have each named fault."""
        flat = np.asarray(codes).reshape(-1)
        return {name: int(((flat & bit) != 0).sum()) for bit, name in cls.NAMES.items()}


class Pytree:
    """Base of every struct: `replace` (added by `flax.struct.dataclass`), and indexing along the leading axis."""

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields replaced."""
        raise NotImplementedError

    def __getitem__(self, index: Any) -> Self:
        """Return row `index` of a batched struct, or the rows of a slice or an index array."""
        return jax.tree.map(lambda leaf: leaf[index], self)


@flax.struct.dataclass
class Scene(Pytree):
    """The objects on the table, without their poses.

    Example:
      names, scenes, poses = dipn_jax.load_cases()    # a dipn_jax.Scene with a leading axis
      scenes[0].replace(friction=np.full(6, 0.2))
    """

    shape: Int[Array, "*b N"]  # index into shapes.CLASSES, ABSENT where the slot is empty
    size: Float[Array, "*b N 3"]  # metres: bounding box along the object's own axes
    color: Float[Array, "*b N 3"]  # in [0, 1]: RGB
    mass: Float[Array, "*b N"]  # kg
    friction: Float[Array, "*b N"]  # sliding coefficient between the object and the table


@flax.struct.dataclass
class Observation(Pytree):
    """What the camera sees from straight above, orthographic.

    Example:
      observation = dipn_jax.Observation(height, color, label, slots=10)
    """

    height: Float[Array, "*b H W"]  # metres above the table
    color: Float[Array, "*b H W 3"]  # in [0, 1]
    label: Int[Array, "*b H W"]  # object slot, ABSENT on the table
    slots: int = flax.struct.field(pytree_node=False)  # N: labels are below; static, as it shapes programs


@flax.struct.dataclass
class Push(Pytree):
    """A straight horizontal sweep with the closed gripper.

    Example:
      push = dipn_jax.Push(start=np.array([-0.1, 0.0]), angle=np.float32(0.0), distance=np.float32(0.1))
    """

    start: Float[Array, "*b 2"]  # metres, workspace: where the gripper comes down
    angle: Float[Array, "*b"]  # radians: direction of travel
    distance: Float[Array, "*b"]  # metres


@flax.struct.dataclass
class Grasp(Pytree):
    """A top-down grasp.

    Example:
      grasp = dipn_jax.Grasp(center=np.array([0.0, 0.05]), angle=np.float32(0.0), height=np.float32(0.02))
    """

    center: Float[Array, "*b 2"]  # metres, workspace: midpoint between the fingers
    angle: Float[Array, "*b"]  # radians: direction of the closing axis
    height: Float[Array, "*b"]  # metres: fingertips above the table


@flax.struct.dataclass
class Trajectory(Pytree):
    """Set points of the gripper, linear between `K` key frames."""

    time: Float[Array, "*b K"]  # seconds, increasing
    target: Float[Array, "*b K 5"]  # x, y, tip height (metres), yaw of the closing axis (radians), inner gap (metres)


@flax.struct.dataclass
class Rollout(Pytree):
    """What a simulation returns."""

    poses: Float[Array, "*b S N 7"]  # position (metres) and quaternion wxyz, workspace
    gripper: Float[Array, "*b S 5"]  # as Trajectory.target, as reached
    fault: Int[Array, "*b"]  # bits of Fault


@flax.struct.dataclass
class Outcome(Pytree):
    """The result of a grasp."""

    held: Bool[Array, "*b N"]  # objects in the hand after the lift
    success: Bool[Array, "*b"]  # at least one


@flax.struct.dataclass
class PushEpisode(Pytree):
    """One push, with everything needed to render it before, during and after."""

    scene: Scene
    poses: Float[
        Array, "*b 11 N 7"
    ]  # before, then at 1, ..., 10 cm of travel (every 0.1 s, also after `push.distance`)
    after: Float[Array, "*b N 7"]  # at rest, the gripper gone
    push: Push
    fault: Int[Array, "*b"]  # bits of Fault


@flax.struct.dataclass
class GraspEpisode(Pytree):
    """One grasp and whether it held."""

    scene: Scene
    poses: Float[Array, "*b N 7"]  # before
    after: Float[Array, "*b N 7"]  # after the lift
    grasp: Grasp
    held: Bool[Array, "*b N"]  # objects in the hand after the lift
    success: Bool[Array, "*b"]  # at least one
    fault: Int[Array, "*b"]  # bits of Fault


@flax.struct.dataclass
class SettledScene(Pytree):
    """A scene at rest; the data set of images consists of these."""

    scene: Scene
    poses: Float[Array, "*b N 7"]  # position (metres) and quaternion wxyz, workspace
    fault: Int[Array, "*b"]  # bits of Fault


@flax.struct.dataclass
class Candidates(Pytree):
    """The actions to choose from on one table: the best grasp, and pushes."""

    pushes: Push  # [P]
    feasible: Bool[Array, "*b P"]
    grasp_pixel: Int[Array, "*b 3"]  # rotation, row, col of the best grasp
    grasp_score: Float[Array, "*b"]  # score of that grasp in [0, 1]
    value_now: Float[Array, "*b"]  # mean score of all grasps
    grasp_now: Bool[Array, "*b"]  # whether to take the best grasp without comparing pushes


@flax.struct.dataclass
class Decision(Pytree):
    """The action chosen on one table, and what it was compared with.

    `value_now` and `value_push` have the method's unit. Alg. 2 (dipn+gn, rea+dipn, physics+gn): the mean score of all
    grasps, times gamma after a push. dipn+gn+actions: minus the expected number of actions besides one for each object.
    vpg, dqn+gn: the value that a network predicts.

    Example:
      decision = policy(key, observation)             # a dipn_jax.Decision
      action = decision.push if decision.is_push else decision.grasp
    """

    is_push: Bool[Array, "*b"]
    push: Push  # the best one
    grasp: Grasp  # the best one
    grasp_pixel: Int[Array, "*b 3"]  # rotation, row, col of it
    grasp_score: Float[Array, "*b"]  # score of it in [0, 1], or its value
    value_now: Float[Array, "*b"]  # what the grasp is worth: mean score; or minus expected actions; or its value
    value_push: Float[Array, "*b"]  # what the best push is worth, in the same unit; -inf if none is feasible
    motion: Float[Array, "*b N 3"]  # predicted dx, dy (metres), dtheta (radians) for the best push
    best: Int[Array, "*b"] | None = None  # index of the best push among the candidates
    values: Float[Array, "*b P"] | None = None  # gamma times mean score, or value, of each; -inf: not feasible
    candidates: Candidates | None = None
    predicted: Float[Array, "*b H W 4"] | None = None  # predicted RGB and height after the best push

    def brief(self) -> Decision:
        """Return the decision without its candidates and images, to be kept for many tables."""
        brief: Decision = self.replace(best=None, values=None, candidates=None, predicted=None)
        return brief


def concatenate(batches: list[T]) -> T:
    """Join structs along their leading axis, as NumPy arrays."""
    return jax.tree.map(lambda *leaves: np.concatenate([np.asarray(leaf) for leaf in leaves]), *batches)


def take(episodes: T, index: np.ndarray | slice | int) -> T:
    """Return the episodes `index` of a batched struct, as NumPy arrays."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[index], episodes)


def stack(items: list[T]) -> T:
    """Stack structs of one kind along a new leading axis, as NumPy arrays."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *items)


def cast(items: T) -> T:
    """Return a copy as NumPy arrays, with every floating-point leaf as float32."""

    def one(leaf: Any) -> np.ndarray:
        array = np.asarray(leaf)
        return array.astype(np.float32) if array.dtype.kind == "f" else array

    return jax.tree.map(one, items)
