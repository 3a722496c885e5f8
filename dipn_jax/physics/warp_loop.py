"""Kernels of the control loop on the device: set points, the fence's forces, and what faults are judged by.

They compute what `hosted` computes on the host, in float64 as there, so the loop needs nothing from the host between
its start and its end. Times are counted in control periods, from a counter on the device, so that one recorded
period serves the whole rollout.
"""

import functools
import types
import typing

from dipn_jax import physics
from dipn_jax.workspace import GRIPPER
from dipn_jax.world.model import GRIPPER_DOF


@functools.cache
@typing.no_type_check
def kernels() -> types.SimpleNamespace:
    """Return the kernels; made on demand, because Warp is an extra."""
    import warp as wp

    period, lag = physics.CONTROL_PERIOD, GRIPPER.lag
    reach, rate, dof = physics.FENCE, physics.FENCE_RATE, GRIPPER_DOF

    @wp.func
    def set_point(
        frame_time: wp.array2d[float], frame: wp.array3d[float], world: int, when: wp.float64, k: int
    ) -> wp.float64:
        """Return coordinate k of the path of a world: linear between key frames."""
        passed = int(0)  # noqa: RUF046, UP018  # Warp takes a plain 0 for a constant
        for i in range(frame_time.shape[1]):
            if wp.float64(frame_time[world, i]) <= when:
                passed += 1
        i = wp.clamp(passed - 1, 0, frame_time.shape[1] - 2)
        span = wp.max(frame_time[world, i + 1] - frame_time[world, i], 1.0e-9)
        weight = (when - wp.float64(frame_time[world, i])) / wp.float64(span)
        weight = wp.clamp(weight, wp.float64(0.0), wp.float64(1.0))
        return wp.float64(frame[world, i, k]) * (wp.float64(1.0) - weight) + wp.float64(frame[world, i + 1, k]) * weight

    @wp.kernel(enable_backward=False)
    def steer(tick: wp.array[int], frame_time: wp.array2d[float], frame: wp.array3d[float], ctrl: wp.array2d[float]):
        """Set the actuators' set points of the next period, ahead by the gripper's lag; half the gap a finger."""
        world = wp.tid()
        when = wp.float64(tick[0]) * wp.float64(wp.static(period)) + wp.float64(wp.static(lag))
        for k in range(4):
            ctrl[world, k] = float(set_point(frame_time, frame, world, when, k))
        half = float(set_point(frame_time, frame, world, when, 4) / wp.float64(2.0))
        ctrl[world, 4] = half
        ctrl[world, 5] = half

    @wp.kernel(enable_backward=False)
    def apply_fence(
        tick: wp.array[int],
        fence: wp.array[wp.float64],
        mass: wp.array2d[wp.float64],
        qpos: wp.array2d[float],
        qvel: wp.array2d[float],
        force: wp.array2d[float],
    ):
        """Apply the fence's forces along x and y for the next period; none after it has been taken away."""
        world, slot, k = wp.tid()
        at = wp.float64(qpos[world, wp.static(dof) + 7 * slot + k])
        edge, fast = wp.float64(wp.static(reach)), wp.float64(wp.static(rate))
        beyond = at - wp.clamp(at, -edge, edge)
        pull = wp.float64(0.0)
        if wp.float64(tick[0]) * wp.float64(wp.static(period)) < fence[0] and beyond != wp.float64(0.0):
            speed = wp.float64(qvel[world, wp.static(dof) + 6 * slot + k])
            pull = mass[world, slot] * (-(fast * fast) * beyond - wp.float64(2.0) * fast * speed)
        force[world, wp.static(dof) + 6 * slot + k] = float(pull)

    @wp.kernel(enable_backward=False)
    def count(taken: wp.array[int], histogram: wp.array[wp.int64]):
        """Count how many iterations the solver has taken in each world."""
        wp.atomic_add(histogram, wp.min(taken[wp.tid()], histogram.shape[0] - 1), wp.int64(1))

    @wp.kernel(enable_backward=False)
    def watch(
        tick: wp.array[int],
        frame_time: wp.array2d[float],
        frame: wp.array3d[float],
        qpos: wp.array2d[float],
        qvel: wp.array2d[float],
        fastest: wp.array2d[wp.float64],
        off: wp.array2d[wp.float64],
    ):
        """Note squared speeds of the objects, and how far the hand is off its path; what is not a number stays."""
        world = wp.tid()
        for slot in range(fastest.shape[1]):
            square = wp.float64(0.0)
            for k in range(3):
                speed = wp.float64(qvel[world, wp.static(dof) + 6 * slot + k])
                square += speed * speed
            if wp.isnan(square) or square > fastest[world, slot]:
                fastest[world, slot] = square
        when = wp.float64(tick[0] + 1) * wp.float64(wp.static(period))
        for k in range(3):
            apart = wp.abs(wp.float64(qpos[world, k]) - set_point(frame_time, frame, world, when, k))
            if wp.isnan(apart) or apart > off[world, k]:
                off[world, k] = apart

    @wp.kernel(enable_backward=False)
    def note_depth(
        tick: wp.array[int],
        since: wp.array[wp.float64],
        contacts: wp.array[int],
        world: wp.array[int],
        distance: wp.array[float],
        deepest: wp.array[float],
    ):
        """Record each world's deepest contact, once the grace time is over."""
        i = wp.tid()
        counts = wp.float64(tick[0]) * wp.float64(wp.static(period)) >= since[0]
        if i < contacts[0] and counts and distance[i] < 0.0:
            wp.atomic_max(deepest, world[i], -distance[i])

    @wp.kernel(enable_backward=False)
    def advance(tick: wp.array[int]):
        """Count a control period."""
        tick[0] = tick[0] + 1

    return types.SimpleNamespace(
        steer=steer, apply_fence=apply_fence, count=count, watch=watch, note_depth=note_depth, advance=advance
    )
