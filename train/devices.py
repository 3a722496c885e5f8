"""Where training steps are computed: on one device, or each batch shared by all devices of a machine or of a job."""

from __future__ import annotations

import concurrent.futures
import json
import os
import re
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.system import typed

from .configs import Compute

SYNC_EVERY = 10
"""Steps after which the processes of a job ask one another whether one of them has been interrupted."""
WAIT_LIMIT_SECONDS = 300
"""Seconds that a process waits for the others of its job."""
WAIT_NOTICE_SECONDS = 10
"""Seconds after which it says that it does."""


class OneDevice:
    """Steps on JAX's default device."""

    leads = True
    """Whether this process writes the run's folder, and says how far it is."""

    def rows(self, batch: np.ndarray) -> np.ndarray:
        """Return those examples of a batch `[B]` that this process fetches."""
        return batch

    def shard_batch(self, examples: Any) -> Any:
        """Return the batch in the form that a step takes; this process contributes the examples of `rows`."""
        return examples

    def replicate(self, tree: Any) -> Any:
        """Copy a pytree to every device."""
        return tree

    def local_copy(self, tree: Any) -> Any:
        """Return this process's copy of a pytree that is the same on every device."""
        return tree

    def any_process_stops(self, said: bool, step: int) -> bool:
        """Return whether any process wants to stop; all call it after each step and agree every SYNC_EVERY steps."""
        return said

    def wait(self, name: str) -> None:
        """Wait until all processes are at the place `name`."""

    def require_alike(self, given: dict[str, Any], *, what: str) -> None:
        """Check that all processes give the same dictionary, which has to fit into JSON; `what` names it in errors.

        Raises:
          UserError: they do not; in every process.
        """


class Shared(OneDevice):
    """Steps whose batches are shared by several devices, each of which has all parameters.

    XLA adds what they find, so a loss or a statistic of a batch is that of the whole batch.
    """

    def __init__(self, devices: Sequence[jax.Device], *, batch: int) -> None:
        """Prepare to share batches of `batch` examples.

        Raises:
          UserError: they cannot be shared equally.
        """
        if batch % len(devices):
            raise UserError(
                f"--batch {batch} --data-parallel: {len(devices)} devices share a batch; want a multiple of that"
            )
        mesh = jax.sharding.Mesh(np.asarray(devices), ("examples",))
        self._each = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("examples"))
        self._all = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
        self.leads = jax.process_index() == 0

    def rows(self, batch: np.ndarray) -> np.ndarray:
        """See `OneDevice`."""
        return np.array_split(batch, jax.process_count())[jax.process_index()]

    def shard_batch(self, examples: Any) -> Any:
        """See `OneDevice`."""
        return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(self._each, np.asarray(leaf)), examples)

    def replicate(self, tree: Any) -> Any:
        """See `OneDevice`."""
        return jax.device_put(tree, self._all)

    def local_copy(self, tree: Any) -> Any:
        """See `OneDevice`."""
        return jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)

    def any_process_stops(self, said: bool, step: int) -> bool:
        """See `OneDevice`."""
        if jax.process_count() == 1:
            return said
        return step % SYNC_EVERY == 0 and bool(multihost_utils.process_allgather(np.asarray(said)).any())

    def wait(self, name: str) -> None:
        """See `OneDevice`."""
        if jax.process_count() > 1:
            multihost_utils.sync_global_devices(name)

    def require_alike(self, given: dict[str, Any], *, what: str) -> None:
        """See `OneDevice`."""
        if jax.process_count() == 1:
            return
        text = np.frombuffer(json.dumps(given).encode(), np.uint8)
        lengths = multihost_utils.process_allgather(np.asarray(len(text)))
        padded = np.pad(text, (0, lengths.max() - len(text)))
        texts = multihost_utils.process_allgather(padded)
        first, *others = (json.loads(one[:length].tobytes()) for one, length in zip(texts, lengths, strict=True))
        for number, other in enumerate(others, 1):
            if names := [name for name in {**first, **other} if first.get(name) != other.get(name)]:
                values = ", ".join(f"{typed.one_line(str(one.get(names[0])), most=80)}" for one in (first, other))
                raise UserError(
                    f"--data-parallel: {names[0]} of processes 0 and {number} of this job differ ({values}): {what}; "
                    "give all processes the same"
                )


def placement(compute: Compute, *, batch: int) -> OneDevice:
    """Return where the steps on batches of `batch` examples are computed.

    Raises:
      UserError: the devices cannot share a batch equally.
    """
    if not compute.data_parallel:
        return OneDevice()
    shared = Shared(jax.devices(), batch=batch)
    if shared.leads:
        here, processes = jax.device_count(), jax.process_count()
        console.say(f"--data-parallel: {here} devices ({jax.default_backend()}) of {processes} processes share a batch")
    return shared


def join(compute: Compute) -> None:
    """Join the other processes of the job, if there are any; call this before anything else in JAX.

    SLURM and Open MPI tell JAX of them, and so does Kubernetes where the package `kubernetes` is installed; elsewhere
    options do.

    Raises:
      UserError: the processes do not find one another.
    """
    if compute.coordinator:
        given = f"--coordinator {compute.coordinator}"
        if compute.process == 0:
            _require_port(compute.coordinator)
        who = compute.coordinator, compute.processes, compute.process
        _in_time(lambda: jax.distributed.initialize(*who, initialization_timeout=2 * WAIT_LIMIT_SECONDS), given)
    elif _started_as_several():
        own = local_devices(os.environ)
        _in_time(
            lambda: jax.distributed.initialize(local_device_ids=own, initialization_timeout=2 * WAIT_LIMIT_SECONDS),
            "the job manager's processes",
        )


def local_devices(environment: Mapping[str, str]) -> list[int] | None:
    """Return the numbers of the GPUs that this process of SLURM or Open MPI takes of those that it sees.

    Where the processes of a machine see the same GPUs, each takes an equal share; where a process is alone there, or
    sees its own, it takes all that it sees. JAX would take one GPU a process, and leave the others idle.

    Args:
      environment: environment variables.

    Returns:
      The numbers; None where the variables do not say how many GPUs or processes there are, or where the processes
      cannot share equally: then JAX decides.
    """
    local = environment.get("OMPI_COMM_WORLD_LOCAL_RANK", environment.get("SLURM_LOCALID", ""))
    count, here = _visible_gpus(environment), _processes_here(environment)
    if not count or not here or not local.isdecimal():
        return None
    own = "SLURM_GPUS_PER_TASK" in environment or "gpu" in environment.get("SLURM_TRES_PER_TASK", "")
    if here == 1 or count < here or own:
        return list(range(count))
    share = count // here
    return None if count % here else list(range(int(local) * share, (int(local) + 1) * share))


def _visible_gpus(environment: Mapping[str, str]) -> int:
    """Return the number of GPUs that a process sees; 0 if no variable says it."""
    if listed := environment.get("CUDA_VISIBLE_DEVICES", environment.get("ROCR_VISIBLE_DEVICES")):
        return len(listed.split(","))
    there = environment.get("SLURM_GPUS_ON_NODE", "")
    return int(there) if there.isdecimal() else 0


def _processes_here(environment: Mapping[str, str]) -> int:
    """Return the number of the job's processes on this machine; 0 if no variable says it."""
    there = environment.get("OMPI_COMM_WORLD_LOCAL_SIZE", "")
    if there.isdecimal():
        return int(there)
    counts: list[int] = []
    for part in environment.get("SLURM_STEP_TASKS_PER_NODE", "").split(","):  # such as 4(x2),3
        found = re.fullmatch(r"(\d+)(?:\(x(\d+)\))?", part)
        if found is None:
            return 0
        counts += [int(found[1])] * int(found[2] or 1)
    node = environment.get("SLURM_NODEID", "")
    return counts[int(node)] if node.isdecimal() and int(node) < len(counts) else 0


def _require_port(coordinator: str) -> None:
    """Raise a UserError if this process cannot listen where it coordinates; JAX would end with a segmentation fault."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", int(coordinator.rpartition(":")[2])))
        except OSError as error:
            raise UserError(
                f"--coordinator {coordinator}: process 0 cannot listen there ({error.strerror}); give another port"
            ) from None


def _in_time(meet: Callable[[], None], given: str) -> None:
    """Call `meet`, which waits for other processes, and let it be interrupted, which JAX's own wait cannot be.

    JAX would abort this process where it has waited too long, so that our patience ends before its own.

    Args:
      meet: the call.
      given: what says who the others are, for messages.

    Raises:
      UserError: the others did not come in time, or JAX cannot find out who they are.
    """
    met: concurrent.futures.Future[None] = concurrent.futures.Future()

    def call() -> None:
        try:
            meet()
        except Exception as error:
            met.set_exception(error)
        else:
            met.set_result(None)

    threading.Thread(target=call, daemon=True).start()
    if not concurrent.futures.wait([met], timeout=WAIT_NOTICE_SECONDS).done:
        console.note(f"{given}: waiting for the other processes, {WAIT_LIMIT_SECONDS:.0f} s at most")
        concurrent.futures.wait([met], timeout=WAIT_LIMIT_SECONDS - WAIT_NOTICE_SECONDS)
    if not met.done():
        raise UserError(
            f"{given}: not all processes came within {WAIT_LIMIT_SECONDS:.0f} s; look whether each of them was "
            "started, and can reach process 0 there"
        )
    if error := met.exception():
        said = typed.one_line(str(error) or type(error).__name__, most=200)
        raise UserError(f"{given}: cannot join ({said}); look at host, port and the numbers of the processes") from None


def _started_as_several() -> bool:
    """Return whether a job manager has started this process as one of several."""
    counts = [os.environ.get(name, "1") for name in ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")]
    indexed = "KUBERNETES_SERVICE_HOST" in os.environ and "JOB_COMPLETION_INDEX" in os.environ
    return indexed or any(count.isdecimal() and int(count) > 1 for count in counts)
