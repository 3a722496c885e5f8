"""Tasks that are lost are run again, and a user's mistake ends the job; with a stand-in for Ray."""

import contextlib
import errno
import importlib.util
import os
import pathlib
import socket
import sys
import time
import types
from typing import Any

import pytest
from dipn_jax.datagen import cli as datagen
from dipn_jax.eval import cli as evaluation

from dipn_jax.commands import console, launch
from dipn_jax.commands.launch import LOCAL, Launch
from dipn_jax.errors import UserError
from dipn_jax.storage import owner


class _Ray(types.ModuleType):
    """Runs tasks when they are waited for, the last one first."""

    def __init__(self, cores: float = 2.0) -> None:
        super().__init__("ray")
        self.cores, self.options = cores, dict[str, Any]()
        self.most_going, self.cancelled, self.strategies = 0, list[Any](), list[str]()
        dead = {
            name: type(name, (Exception,), {}) for name in ("WorkerCrashedError", "NodeDiedError", "OutOfMemoryError")
        }
        self.exceptions = types.SimpleNamespace(**dead)

    def is_initialized(self) -> bool:
        return True

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": self.cores}

    def nodes(self) -> list[dict[str, Any]]:
        return [{"Alive": True, "Resources": {"CPU": self.cores}}, {"Alive": False, "Resources": {"CPU": 64.0}}]

    def remote(self, **options: Any) -> Any:
        self.options = options

        def made(function: Any) -> Any:
            def options(*, scheduling_strategy: str) -> Any:
                return types.SimpleNamespace(remote=lambda *args: (function, (*args, scheduling_strategy)))

            return types.SimpleNamespace(remote=lambda *args: (function, (*args, "")), options=options)

        return made

    def wait(self, going: list[Any], *, num_returns: int) -> tuple[list[Any], list[Any]]:
        self.most_going = max(self.most_going, len(going))
        return going[-num_returns:], going[:-num_returns]

    def get(self, task: Any) -> Any:
        function, (*args, strategy) = task
        self.strategies.append(strategy)
        return function(*args)

    def cancel(self, task: Any, *, force: bool) -> None:
        self.cancelled.append(task)


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> _Ray:
    stand_in = _Ray()
    monkeypatch.setitem(sys.modules, "ray", stand_in)
    monkeypatch.setattr(launch, "RETRY_PAUSE", 0.0)
    return stand_in


def _double(number: int) -> int:
    if number == 5:
        raise UserError("five: want another number")
    if number >= 100:
        raise OSError(number - 100, os.strerror(number - 100), "/data")
    return 2 * number


def test_every_task_is_done_once_and_few_are_submitted_at_a_time(ray: _Ray) -> None:
    tasks = [(number,) for number in range(20, 40)]
    found = dict(launch.run(_double, tasks, launch=Launch("ray", num_cpus=1.0)))
    assert found == {number: 2 * (20 + number) for number in range(20)}
    assert ray.most_going == 4 and ray.cancelled == []
    needs = {"num_cpus": 1.0, "num_gpus": 0.0, "max_calls": 0}
    assert ray.options == {**needs, "max_retries": launch.RETRIES, "retry_exceptions": False}
    list(launch.run(_double, [], launch=Launch("ray"), fresh=True))
    assert ray.options["max_calls"] == 1


@pytest.mark.parametrize(
    ("number", "says"),
    [
        (5, "^five: want another number$"),
        (100 + errno.ENOSPC, f"^on {socket.gethostname()}: /data: No space left on device; mend that and try again$"),
        (100 + errno.EACCES, f"^on {socket.gethostname()}: /data: Permission denied; "),
        (100 + errno.ENOENT, f"^on {socket.gethostname()}: /data: No such file or directory; "),
    ],
)
def test_a_mistake_of_the_users_ends_the_job_and_the_others_are_given_up(number: int, says: str, ray: _Ray) -> None:
    with pytest.raises(UserError, match=says):
        list(launch.run(_double, [(1,), (2,), (number,), (3,), (4,)], launch=Launch("ray")))
    assert [arguments[1] for _, arguments in ray.cancelled] == [(1,), (2,)]


@pytest.mark.parametrize("number", [errno.ESTALE, errno.EIO])
@pytest.mark.parametrize("said", [False, True])
def test_what_the_files_of_a_machine_do_is_tried_again_elsewhere(
    number: int, said: bool, ray: _Ray, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether a task says so itself, or in a line for the user."""
    calls: list[int] = []

    def fails(times: int) -> int:
        calls.append(times)
        if calls.count(times) > times:
            return -times
        try:
            raise OSError(number, os.strerror(number), "/data")
        except OSError:
            if said:
                raise UserError("/data: cannot be read") from None
            raise

    found = dict(launch.run(fails, [(0,), (1,), (launch.RETRIES,)], launch=Launch("ray")))
    assert found == {0: 0, 1: -1, 2: -launch.RETRIES}
    assert sorted(calls) == [0, 1, 1, *[launch.RETRIES] * (launch.RETRIES + 1)]
    assert ray.strategies.count("") == 3 and ray.strategies.count("SPREAD") == 1 + launch.RETRIES
    what = "/data: cannot be read" if said else f"/data: {os.strerror(number)}"
    line = f"fails: on {socket.gethostname()}: {what}"
    assert capsys.readouterr().err == f"warning: {line}; tasks that fail there are run again\n"
    with pytest.raises(UserError, match=f"^fails: failed {launch.RETRIES + 1} times, at last on .*: {what}$"):
        list(launch.run(fails, [(launch.RETRIES + 1,)], launch=Launch("ray")))


@pytest.mark.parametrize("locks", [True, False])
def test_a_folder_that_a_lost_machine_has_is_tried_again_until_its_lock_has_gone(
    locks: bool, ray: _Ray, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file systems here know no leases, so the lock is given up when tasks have waited for 90 s, without sleep."""
    lost, waited = contextlib.ExitStack(), list[float]()

    def sleep(seconds: float) -> None:
        waited.append(seconds)
        if sum(waited) >= 90 and not keeps:
            lost.close()

    def train(name: str) -> str:
        with owner.owned(tmp_path / name):
            return name

    monkeypatch.setattr(time, "sleep", sleep)
    if not locks:
        monkeypatch.setattr(owner, "fcntl", None)
    tasks, keeps = [("a",), ("b",)], False
    lost.enter_context(owner.owned(tmp_path / "a"))
    assert dict(launch.run(train, tasks, launch=Launch("ray"), fresh=True)) == {0: "a", 1: "b"}
    tries = len(waited)
    assert 0 < tries < launch.RETRIES / 2 and ray.strategies == ["", "", *["SPREAD"] * tries]
    line = f"{tmp_path / 'a'}: in use by host {socket.gethostname()}, pid {os.getpid()}, started 2"
    warned = [each for each in capsys.readouterr().err.splitlines() if "in use" in each]
    assert len(warned) == 1 and warned[0].startswith(f"warning: train: {line}")
    keeps = True
    with owner.owned(tmp_path / "a"), pytest.raises(UserError, match=f"^train: failed 17 times, at last {line}"):
        list(launch.run(train, tasks, launch=Launch("ray"), fresh=True))


def test_a_gpu_is_shared_unless_a_task_has_it_and_a_process_to_itself(
    ray: _Ray, monkeypatch: pytest.MonkeyPatch
) -> None:
    def set_to(where: Launch, *, fresh: bool) -> str | None:
        ((_, found),) = launch.run(os.environ.get, [(launch.PREALLOCATE,)], launch=where, fresh=fresh)
        monkeypatch.delenv(launch.PREALLOCATE, raising=False)
        return found

    monkeypatch.setenv(launch.PREALLOCATE, "true")
    LOCAL.begin()
    Launch("ray").begin()
    assert set_to(Launch("ray"), fresh=False) == "true", "the user has set it"
    assert set_to(Launch("ray", num_gpus=1), fresh=True) is None
    assert set_to(Launch("ray", num_gpus=0.5), fresh=True) == "false"
    assert set_to(Launch("ray", num_gpus=1), fresh=False) == "false"
    LOCAL.begin()
    assert launch.PREALLOCATE not in os.environ
    Launch("ray").begin()
    assert os.environ[launch.PREALLOCATE] == "false"


@pytest.mark.parametrize(
    "words",
    [
        "datagen images",
        "datagen push",
        "datagen grasp --grasp-net nowhere",
        "eval clear --of 2 --push-net nowhere --grasp-net nowhere",
        "eval grasp --of 2 --grasp-net nowhere",
        "eval prediction --of 2 --push-net nowhere",
        "eval sweep --of 2 --push-net nowhere --grasp-net nowhere",
    ],
)
def test_a_command_with_tasks_shares_its_gpu_before_it_loads_anything(
    words: str, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def begin(self: Launch) -> None:
        raise UserError(f"begins with {self.launcher}")

    monkeypatch.setattr(Launch, "begin", begin)
    program, *rest = [*words.split(), "--launcher", "ray", "--out", str(tmp_path / "out")]
    assert console.run("test", {"datagen": datagen, "eval": evaluation}[program].COMMANDS, rest) == 2
    assert capfd.readouterr().err == "error: begins with ray\n" and not (tmp_path / "out").exists()


def test_a_task_whose_process_always_dies_ends_the_job(ray: _Ray) -> None:
    def dies(number: int) -> int:
        raise ray.exceptions.WorkerCrashedError("segmentation\nfault")

    with pytest.raises(UserError, match=r"dies: a task's process died 17 times \(segmentation fault\)"):
        list(launch.run(dies, [(1,), (2,)], launch=Launch("ray")))
    assert [arguments[1] for _, arguments in ray.cancelled] == [(1,)]


def test_what_no_machine_has_is_said(ray: _Ray, capsys: pytest.CaptureFixture[str]) -> None:
    assert list(launch.run(_double, [], launch=Launch("ray", num_cpus=2.0))) == []
    assert capsys.readouterr().err == ""
    assert list(launch.run(_double, [], launch=Launch("ray", num_cpus=3.0, num_gpus=1.0))) == []
    assert capsys.readouterr().err == "warning: no machine of the cluster has 3 cores and 1 GPUs; waiting\n"


def test_without_ray_a_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"--launcher ray: Ray is not installed; pip install 'dipn-jax\[ray\]'"):
        list(launch.run(_double, [(1,)], launch=Launch("ray")))


@pytest.mark.parametrize("where", ["127.0.0.1:{port}", "[::1]:{port}", "localhost:99999"])
def test_a_cluster_that_does_not_answer_is_not_waited_for(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in = _Ray()
    stand_in.is_initialized = lambda: False  # type: ignore[method-assign]
    monkeypatch.setitem(sys.modules, "ray", stand_in)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))  # bound, and nobody listens
        monkeypatch.setenv("RAY_ADDRESS", where.format(port=free.getsockname()[1]))
        with pytest.raises(UserError, match=r"no cluster at RAY_ADDRESS=.*; start one with"):
            list(launch.run(_double, [(1,)], launch=Launch("ray")))


def test_a_task_has_as_many_threads_as_cores() -> None:
    assert LOCAL.threads(None) is None and LOCAL.threads(0) == 0 and LOCAL.threads(3) == 3
    assert [Launch("ray", num_cpus=cores).threads(None) for cores in (0.5, 1.0, 4.0)] == [1, 1, 4]
    assert Launch("ray", num_cpus=4.0).threads(2) == 2
    with pytest.raises(UserError, match="--num-cpus, --num-gpus: for --launcher ray only"):
        Launch(num_cpus=2.0)
    with pytest.raises(UserError, match="--num-cpus 0"):
        Launch("ray", num_cpus=0.0)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install '.[ray]'")
def test_a_cluster_gives_gpus_to_those_who_ask_and_tries_again_what_files_failed(tmp_path: pathlib.Path) -> None:
    """One process serves several tasks, which compile once then; in a sweep each has its own."""
    import ray_cluster

    def where(number: int) -> tuple[str, int, str | None]:
        import ray

        return ray.get_runtime_context().get_node_id(), os.getpid(), os.environ.get("CUDA_VISIBLE_DEVICES")

    def write(name: str) -> str:
        (tmp_path / name).open("x").close()
        raise OSError(errno.ESTALE, "Stale file handle", str(tmp_path / name))

    def written(name: str) -> str:
        return name if (tmp_path / name).exists() else write(name)

    def is_full(name: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", name)

    tasks = [(number,) for number in range(4)]
    with ray_cluster.of_nodes(1, gpus=1) as cluster:
        with_gpu = cluster.nodes[1].node_id
        for fresh in (False, True):
            found = dict(launch.run(where, tasks, launch=Launch("ray", num_gpus=1), fresh=fresh))
            assert {node for node, _, _ in found.values()} == {with_gpu}
            assert {devices for _, _, devices in found.values()} == {"0"}
            assert (len({process for _, process, _ in found.values()}) == 4) is fresh
        assert dict(launch.run(written, [("a",), ("b",)], launch=Launch("ray"))) == {0: "a", 1: "b"}
        with pytest.raises(UserError, match=f"^on {socket.gethostname()}: /data: No space left on device; mend that"):
            list(launch.run(is_full, [("/data",)], launch=Launch("ray")))
