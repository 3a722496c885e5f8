"""A Ray cluster of several nodes on this machine, and how some of it is lost."""

from __future__ import annotations

import contextlib
import os
import pathlib
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

STARTS_WITHIN = 180.0
"""Seconds within which a node has to have started; Ray's own patience of 30 s is too short for a busy machine."""


@contextlib.contextmanager
def of_nodes(count: int, *, gpus: int = 0) -> Iterator[Any]:
    """Start a cluster of a head without cores and `count` nodes with one core each; connect to it.

    Others, `gpus` of them, have a core and what Ray takes for a GPU.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    import ray
    from ray.cluster_utils import Cluster

    look = ray._private.services.get_node

    def patient(*args: Any) -> Any:
        until = time.monotonic() + STARTS_WITHIN
        while time.monotonic() < until:
            with contextlib.suppress(RuntimeError):
                return look(*args)
            time.sleep(0.1)
        return look(*args)

    small = {"object_store_memory": 100 * 2**20}
    with mock.patch.object(ray._private.services, "get_node", patient):
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False, **small})
    try:
        with mock.patch.object(ray._private.services, "get_node", patient):
            own = [{"num_cpus": 1, "num_gpus": int(number >= count), **small} for number in range(count + gpus)]
            cluster.nodes = [cluster.add_node(**each) for each in own]
        ray.init(cluster.address, log_to_driver=False, logging_level="ERROR")
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()


def kill_workers(cluster: Any) -> int:
    """Kill every process of the cluster's nodes that runs a task, and return how many there were."""
    raylets = {info.process.pid for node in cluster.nodes for info in node.all_processes["raylet"]}
    killed = 0
    for folder in pathlib.Path("/proc").iterdir():
        with contextlib.suppress(OSError):  # it has ended
            if not folder.name.isdecimal():
                continue
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if parent in raylets and b"_attempt" in (folder / "cmdline").read_bytes():
                os.kill(int(folder.name), signal.SIGKILL)
                killed += 1
    return killed


def losing(cluster: Any, run: Callable[..., Any], lost: list[int]) -> Callable[..., Iterator[tuple[int, Any]]]:
    """Return `launch.run` that removes a node and kills all workers once, when the first task has ended.

    Args:
      cluster: what `of_nodes` yields.
      run: `launch.run`.
      lost: the number of workers killed is appended to it.
    """

    def running(*args: Any, **named: Any) -> Iterator[tuple[int, Any]]:
        for one in run(*args, **named):
            if not lost:
                cluster.remove_node(cluster.nodes.pop(), allow_graceful=False)
                lost.append(kill_workers(cluster))
            yield one

    return running
