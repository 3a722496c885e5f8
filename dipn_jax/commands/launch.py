"""Tasks of a job, on the machines of a Ray cluster. Importing this imports neither Ray nor JAX.

A task writes its result to the folder that all machines share, and returns a few words about it. One that is lost, with
its process or its machine, that a file system of its machine fails, or whose folder a lost machine still has, is run
again, up to RETRIES times; a mistake of the user's ends the job with its line.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import errno
import os
import signal
import socket
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any, Literal

from dipn_jax.commands import console
from dipn_jax.errors import InUse, UserError
from dipn_jax.system import addresses, machine
from dipn_jax.system.interruption import STOP_SIGNALS

SUBMITTED_PER_SLOT = 2
"""Tasks that are submitted for each one that the cluster can run at a time."""
ANSWERS_WITHIN = 20.0
"""Seconds within which a cluster has to accept a connection."""
RETRIES = 16
"""Times that a task is run again whose process or machine died: machines come and go, but a task can be at fault."""
USER_FILE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT)
"""Errors of files that end the job: the user has to mend them. Others, as ESTALE, are taken for the machine's own."""
MACHINE_FILE_ERRORS = (errno.EIO, errno.ESTALE, errno.ETIMEDOUT)
"""Errors of files that are the machine's own, too, where a UserError was made of them."""
RETRY_PAUSE = 5.0
"""Seconds that a task waits which a machine's files have failed, or a broken machine would take the others' tasks."""
IN_USE_PAUSE = 30.0
"""Seconds that a task waits whose folder is in use, perhaps by itself on a machine that is lost. The lock of such a
machine goes with its lease of NFS 4, by default after 90 s on Linux; RETRIES times this is eight minutes."""
STORE_BYTES = 100 * 2**20
"""Memory for results of tasks, on a cluster that is started here: they are a few words."""
PREALLOCATE = "XLA_PYTHON_CLIENT_PREALLOCATE"
"""Variable of the environment: whether JAX takes three quarters of a GPU's memory when it begins to compute."""


@dataclasses.dataclass(frozen=True)
class Launch:
    """Where a job runs."""

    launcher: Literal["local", "ray"] = "local"
    """local: on this machine, without Ray; ray: as tasks of the cluster at RAY_ADDRESS, or of one started here."""
    num_cpus: float = 1.0
    """Cores that ray reserves for each task; native simulates on as many threads, unless --threads says otherwise."""
    num_gpus: float = 0.0
    """GPUs that ray reserves for each task."""

    def __post_init__(self) -> None:
        console.require_between(0.01, 4096, num_cpus=self.num_cpus)
        console.require_between(0, 64, num_gpus=self.num_gpus)
        if self.launcher == "local" and (self.num_cpus, self.num_gpus) != (1.0, 0.0):
            raise UserError("--num-cpus, --num-gpus: for --launcher ray only; here, give --threads")

    @property
    def uses_cluster(self) -> bool:
        """Whether the job runs as tasks."""
        return self.launcher != "local"

    def begin(self) -> None:
        """Let this process leave a GPU's memory to the tasks of the job; to be called before JAX computes anything."""
        if self.uses_cluster:
            _share_gpu()

    def threads(self, given: int | None) -> int | None:
        """Return the threads of the native engine: those given, or in a task one per core that it has reserved."""
        return max(1, int(self.num_cpus)) if self.uses_cluster and given is None else given


LOCAL = Launch()
"""Everything in this process."""


def run(
    function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], *, launch: Launch, fresh: bool = False
) -> Generator[tuple[int, Any], None, None]:
    """Call `function(*task)` for every task, on the cluster; yield number and result of each as it ends.

    Args:
      function: of a module of this package, which every machine of the cluster has.
      tasks: arguments of each call.
      launch: what a task needs.
      fresh: give each task a process of its own, which ends with it.

    Raises:
      UserError: a task raised it, its process died each time, or each time files of its machine failed or its folder
        was in use, and the others are given up; or there is no Ray or no cluster.
    """
    with _connected() as ray:
        _warn_of_too_little(ray, launch)
        needs = {"num_cpus": launch.num_cpus, "num_gpus": launch.num_gpus}
        # 0: a process serves many tasks; with GPUs, Ray would begin one for each, which compiles everything again
        needs |= {"max_calls": 1 if fresh else 0}
        remote = ray.remote(max_retries=RETRIES, retry_exceptions=False, **needs)(_attempt)
        shares = not fresh or launch.num_gpus < 1
        elsewhere = remote.options(scheduling_strategy="SPREAD")  # on one machine after another
        waiting, going = collections.deque(enumerate(tasks)), dict[Any, tuple[int, Any]]()
        failed, named = collections.Counter[int](), set[str]()
        try:
            while waiting or going:
                while waiting and len(going) < _window(ray, launch):
                    number, task = waiting.popleft()
                    going[(elsewhere if failed[number] else remote).remote(function, task, shares)] = number, task
                for done in ray.wait(list(going), num_returns=1)[0]:
                    number, task = going.pop(done)
                    ended = _ended(ray, done, function)
                    if ended.trouble is None:
                        yield number, ended.result
                        continue
                    failed[number] += 1
                    if failed[number] > RETRIES:
                        raise UserError(f"{function.__name__}: failed {RETRIES + 1} times, at last {ended.trouble}")
                    waiting.append((number, task))
                    if ended.where not in named:
                        named.add(ended.where)
                        console.warn(f"{function.__name__}: {ended.trouble}; tasks that fail there are run again")
        finally:
            for left in going:
                ray.cancel(left, force=True)


@dataclasses.dataclass(frozen=True)
class _Ended:
    """How a task ended."""

    result: Any = None
    mistake: str | None = None  # what the user has to mend
    trouble: str | None = None  # what the files of its machine did, or who has its folder: it is run again
    where: str = ""  # the machine or the folder of the trouble, which is named once


def _ended(ray: Any, task: Any, function: Callable[..., Any]) -> _Ended:
    """Return how a task has ended; raise UserError where that is the end of the job."""
    try:
        ended: _Ended = ray.get(task)
    except (ray.exceptions.WorkerCrashedError, ray.exceptions.NodeDiedError, ray.exceptions.OutOfMemoryError) as error:
        why = " ".join(str(error).split())[:200]
        raise UserError(
            f"{function.__name__}: a task's process died {RETRIES + 1} times ({why}); see Ray's logs on that machine, "
            "and give tasks more memory or a smaller --shard-size"
        ) from None
    if ended.mistake is not None:
        raise UserError(ended.mistake)
    return ended


def _share_gpu() -> None:
    """Let JAX take the memory of a GPU as it needs it, unless the user has said otherwise."""
    os.environ.setdefault(PREALLOCATE, "false")


def _attempt(function: Callable[..., Any], task: tuple[Any, ...], shares: bool) -> _Ended:
    """Return what a task returns, or the line that says what is wrong with the files; another error is raised.

    A task that is to be run again waits first.
    It `shares` its GPU where another process may use that, too: one of another task, or one that waits for its next.
    """
    console.prepare()
    if shares:
        _share_gpu()
    here = socket.gethostname()
    try:
        return _Ended(function(*task))
    except InUse as error:
        said = addresses.with_urls(str(error))
        time.sleep(IN_USE_PAUSE)
        return _Ended(trouble=said, where=said)
    except UserError as error:
        # `from None` hides what it was made of, and keeps it
        passes = isinstance(error.__context__, OSError) and error.__context__.errno in MACHINE_FILE_ERRORS
        said = str(error)
    except OSError as error:
        passes = error.errno not in USER_FILE_ERRORS
        said = f"{error.filename or 'files'}: {error.strerror or error}"
        said = said if passes else f"on {here}: {said}; mend that and try again"
    said = addresses.with_urls(said)
    if not passes:
        return _Ended(mistake=said)
    time.sleep(RETRY_PAUSE)
    return _Ended(trouble=f"on {here}: {said}", where=here)


def _window(ray: Any, launch: Launch) -> int:
    """Return how many tasks are submitted at a time: enough that no machine waits, few for the cluster to keep."""
    there = ray.cluster_resources()
    asked = [(there.get("CPU", 0.0), launch.num_cpus), (there.get("GPU", 0.0), launch.num_gpus)]
    return max(SUBMITTED_PER_SLOT, SUBMITTED_PER_SLOT * int(min(has / need for has, need in asked if need)))


def _warn_of_too_little(ray: Any, launch: Launch) -> None:
    """Warn if no machine of the cluster has what a task needs: the task then waits for one that has."""
    alive = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    needs = {"CPU": launch.num_cpus, "GPU": launch.num_gpus}
    if not any(all(node.get(name, 0.0) >= need for name, need in needs.items()) for node in alive):
        console.warn(f"no machine of the cluster has {launch.num_cpus:g} cores and {launch.num_gpus:g} GPUs; waiting")


def _require_answer(address: str | None) -> None:
    """Raise a UserError if nothing answers at HOST:PORT, for which Ray would wait many minutes."""
    host, _, port = (address or "").rpartition(":")
    if not port.isdecimal() or "/" in host:  # none, `auto`, `local` or ray://...
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), ANSWERS_WITHIN).close()
    except (OSError, OverflowError) as error:
        raise UserError(
            f"--launcher ray: no cluster at RAY_ADDRESS={address} ({error}); start one with `ray start --head`"
        ) from None


@contextlib.contextmanager
def _connected() -> Iterator[Any]:
    """Return Ray, connected to a cluster within a `with` statement."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError:
        raise UserError("--launcher ray: Ray is not installed; pip install 'dipn-jax[ray]'") from None
    if ray.is_initialized():
        yield ray
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, *STOP_SIGNALS)}
    quiet = {"log_to_driver": False, "logging_level": "ERROR"}
    address = os.environ.get("RAY_ADDRESS")
    _require_answer(address)
    try:
        if address:
            ray.init(address, **quiet)
        else:
            here = {"num_cpus": machine.cores(), "object_store_memory": STORE_BYTES, "include_dashboard": False}
            ray.init("local", **here, **quiet)
    except (ConnectionError, RuntimeError, ValueError) as error:
        why = " ".join(str(error).split())[:200]
        at = f"no cluster at RAY_ADDRESS={address}" if address else "no cluster could be started here"
        raise UserError(f"--launcher ray: {at} ({why}); start one with `ray start --head`") from None
    try:
        with contextlib.suppress(ValueError):  # only the main thread may
            for number, handler in handlers.items():  # Ray has set its own
                signal.signal(number, handler)
        yield ray
    finally:
        ray.shutdown()
