"""Several trainings by one command: what is trained, what is left, and what happens when something is lost."""

import concurrent.futures
import functools
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from dipn_jax.train import cli, sweep_command, sweeping

from dipn_jax.commands import console, launch
from dipn_jax.commands.launch import Launch
from dipn_jax.storage import checkpoint
from dipn_jax.system import files

PROCESS = """
import json, os, pathlib, signal, sys, threading, time

def listen():
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)

threading.Thread(target=listen, daemon=True).start()
signal.signal(signal.SIGTERM, signal.default_int_handler)
for words in json.loads(sys.argv[1]):
    given = dict(zip(words, words[1:]))
    out, limit = pathlib.Path(given["--out"]), int(given.get("--limit", 1))
    if "--check-only" in words:
        if limit == 99:
            print("error: --limit 99: want 1 to 20", file=sys.stderr)
            sys.exit(2)
        continue
    out.mkdir(parents=True, exist_ok=True)
    with (out / "starts").open("a") as stream:
        stream.write("x")
    starts = len((out / "starts").read_text())
    print(f"train: {starts}", file=sys.stderr, flush=True)
    if limit == 13 and starts == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    if limit == 14 and starts == 1:
        print("error: the disk is full", file=sys.stderr)
        sys.exit(2)
    try:
        time.sleep(60 if limit == 15 and starts == 1 else 0)
    except KeyboardInterrupt:
        (out / "saved").touch()
        sys.exit(130)
    lines = [{"step": 3, "loss": 1.0}, {"step": 6, "loss": limit / 8}]
    (out / "metrics.jsonl").write_text("\\n".join(map(json.dumps, lines)))
"""
"""For `child_process`: first, training on 13 episodes is killed, on 14 has a mistake, on 15 waits to be stopped."""


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let processes train nothing, as PROCESS says."""
    monkeypatch.setattr(sweeping, "_program", lambda commands: [sys.executable, "-c", PROCESS, json.dumps(commands)])


def _sweep(out: pathlib.Path, *words: str, command: tuple[str, ...] = ("push", "--data", "data")) -> int:
    return console.run("test", cli.COMMANDS, ["sweep", "--out", str(out), *words, "--", *command])


def _starts(out: pathlib.Path) -> dict[str, int]:
    return {path.parent.name: len(path.read_text()) for path in sorted(out.glob("*/starts"))}


def test_each_seed_and_limit_is_trained_once_and_more_can_be_added(
    quick: None, tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert _sweep(tmp_path, "--seeds", "0", "3", "--limits", "8", "13", "--at-once", "2") == 0
    assert _starts(tmp_path) == {"8-0": 1, "13-0": 2, "8-3": 1, "13-3": 2}, "those that are killed continue"
    said = capfd.readouterr()
    assert "13-3: its process was killed (-9); continues" in said.err and "13-3: train: 2" in said.err
    assert "/4] 13-0: step 6, loss 1.625\n" in said.out
    table = ["training  step   loss", "     8-0     6      1", "    13-0     6  1.625"]
    assert said.out.splitlines()[-5:-2] == table
    assert _sweep(tmp_path, "--seeds", "0", "1", "--limits", "8", "16") == 0
    assert _starts(tmp_path) == {"8-0": 1, "13-0": 2, "8-3": 1, "13-3": 2, "16-0": 1, "8-1": 1, "16-1": 1}
    said = capfd.readouterr()
    assert said.out.splitlines()[:3] == [f"[{i}/4] {name}" for i, name in
        ((2, "16-0: step 6, loss 2"), (3, "8-1: step 6, loss 1"), (4, "16-1: step 6, loss 2"))]  # fmt: skip
    kept = files.read_json(tmp_path / sweep_command.RECORD)
    assert kept["command"] == ["push", "--data", str(pathlib.Path("data").absolute())]
    assert kept["trainings"]["13-3"] == {"seed": 3, "limit": 13, "values": {"step": 6, "loss": 1.625}}
    assert len(kept["trainings"]) == 7 and not (tmp_path / "owner.json").exists()
    shutil.rmtree(tmp_path / "8-0")
    assert _sweep(tmp_path, "--limits", "8", "13") == 0
    assert _starts(tmp_path)["8-0"] == 1 and _starts(tmp_path)["13-0"] == 2
    assert _sweep(tmp_path) == 0 and _sweep(tmp_path, command=("push", "--data", "data", "--limit", "9")) == 0
    assert {"seed-0", "9-0"} < set(_starts(tmp_path))


def test_each_limit_may_have_its_own_steps(quick: None, tmp_path: pathlib.Path) -> None:
    assert _sweep(tmp_path, "--limits", "8", "16", "--steps", "3", "5") == 0
    planned = sweep_command.plan(("push", "--data", "data"), tmp_path, seeds=(0, 1), limits=(8, 16), steps=(3, 5))
    assert [(each.name, each.given["config"].steps) for each in planned] == [
        ("8-0", 3), ("16-0", 5), ("8-1", 3), ("16-1", 5)]  # fmt: skip
    assert "--steps 5" in " ".join(planned[1].words())
    kept = files.read_json(tmp_path / sweep_command.RECORD)
    assert kept["command"] == ["push", "--data", str(pathlib.Path("data").absolute())]
    assert [kept["trainings"][name]["steps"] for name in ("8-0", "16-0")] == [3, 5]
    assert _sweep(tmp_path, "--limits", "16", "8", "--steps", "5", "4") == 0
    assert _starts(tmp_path) == {"8-0": 2, "16-0": 1}, "one that is to make more steps continues"


def test_a_mistake_ends_the_job_before_anything_is_written(
    quick: None, tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    push = ("push", "--data", "data")
    for words, command, says in (
        (("--limits", "8", "99"), push, "--limit 99: want 1 to 20"),
        (("--seeds", "1", "1"), push, "--seeds 1 1: want none twice"),
        (("--seeds",), push, "--seeds: want at least one"),
        (("--seeds", "-1"), push, "--seed -1"),
        (("--at-once", "0"), push, "--at-once 0"),
        (("--at-once", "2", "--launcher", "ray"), push, "--at-once: for --launcher local"),
        (("--limits", "8"), (*push, "--limit", "8"), "--limits, and --limit 8 after --: give one of them"),
        (("--limits", "8", "9", "--steps", "3"), push, "--steps 3: 1 for 2 of --limits; give one for each"),
        (("--steps", "3"), push, "--steps 3: 1 for 0 of --limits"),
        (("--limits", "8", "--steps", "0"), push, "--steps 0: want whole numbers from 1 on"),
        (("--limits", "8", "--steps", "3"), (*push, "--steps=9"), "--steps 3, and --steps after --; give one of them"),
        (("--limits", "8"), ("grasp-pretrain", "--data", "data"), "dipn-train grasp-pretrain takes no --limit"),
        ((), (*push, "--seed=1"), "--seed=1 after --; give --out and --seeds before it"),
        ((), (*push, "--compile-only"), "leave out --compile-only"),
        ((), (), "nothing after --; want the command of a training, one of push, "),
        ((), ("export",), "export after --; want the command of a training"),
    ):
        assert _sweep(out, *words, command=command) == 2, says
        error = capfd.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1 and says in error
    with pytest.raises(SystemExit) as stop:
        _sweep(out, command=(*push, "--bananas", "3"))
    assert stop.value.code == 2 and not out.exists()


def test_a_training_that_cannot_go_on_ends_the_job_and_the_others_save(
    quick: None, tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ("--limits", "15", "8", "14", "--at-once", "2")
    assert _sweep(tmp_path, *words) == 2
    assert capfd.readouterr().err.splitlines()[-1] == "error: the disk is full"
    assert (tmp_path / "15-0" / "saved").exists() and _starts(tmp_path) == {"15-0": 1, "8-0": 1, "14-0": 1}
    assert _sweep(tmp_path, *words) == 0
    assert _starts(tmp_path) == {"15-0": 2, "8-0": 1, "14-0": 2}
    capfd.readouterr()
    assert _sweep(tmp_path, command=("push", "--data", "data", "--steps", "7")) == 2
    assert "has trainings by `dipn-train push --data " in capfd.readouterr().err


def test_an_interruption_lets_the_trainings_save(
    quick: None, tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def interrupt() -> None:
        until = time.monotonic() + 60
        while not (tmp_path / "15-1" / "starts").exists() and time.monotonic() < until:
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=interrupt).start()
    assert _sweep(tmp_path, "--limits", "8", "15", "--seeds", "1") == 130
    assert capfd.readouterr().err.count("interrupted: ") == 1
    assert (tmp_path / "15-1" / "saved").exists()
    assert files.read_json(tmp_path / sweep_command.RECORD)["trainings"]["15-1"]["values"] is None
    assert _sweep(tmp_path, "--limits", "8", "15", "--seeds", "1") == 0 and _starts(tmp_path) == {"15-1": 2, "8-1": 1}


def test_processes_are_stopped_by_their_input_alone_and_none_starts_afterwards() -> None:
    """What a terminal sends to its group would be a second signal, after which nothing is saved."""
    children = sweeping._Children()
    with children.begin([sys.executable, "-c", "import sys; sys.exit(len(sys.stdin.read()) + 7)"]) as process:
        assert os.getpgid(process.pid) == process.pid
        children.stop()
        assert process.wait() == 7
    with pytest.raises(concurrent.futures.CancelledError):
        children.begin([sys.executable, "-c", ""])


def test_a_training_that_is_always_killed_ends_the_job(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    program = [sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"]
    monkeypatch.setattr(sweeping, "_program", lambda _: program)
    monkeypatch.setattr(sweeping, "check", lambda _: None)
    monkeypatch.setattr(sweeping, "RETRIES", 1)
    assert _sweep(tmp_path) == 2
    assert "error: seed-0: its process was killed 2 times, often for memory; see --at-once" in capfd.readouterr().err


def test_tasks_of_a_cluster_train_in_processes_of_their_own(
    quick: None, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def run(function: Any, tasks: Any, *, launch: Launch, fresh: bool) -> Iterator[tuple[int, Any]]:
        assert function is sweeping.train and launch.num_cpus == 3 and fresh
        for number, (kind, given) in enumerate(tasks):
            asked.append((kind, given["config"].seed, given["threads"]))
            yield number, {"step": 6, "success": 0.5}

    monkeypatch.setattr(launch, "run", run)
    words = ("--launcher", "ray", "--num-cpus", "3", "--seeds", "0", "1")
    assert _sweep(tmp_path, *words, command=("grasp-online", "--grasps", "10")) == 0
    assert asked == [("grasp-online", 0, 3), ("grasp-online", 1, 3)]


def test_the_words_of_a_training_are_its_options(tmp_path: pathlib.Path) -> None:
    words = ["push", "--data", "a", "s3://b/c", "--centimetres", "1", "2", "--memory", "0.5", "--optimizer", "sgd"]
    words += ["--init", "builtin", "--precision", "bfloat16", "--without", "cuboid"]
    one, other = sweep_command.plan(words, tmp_path, seeds=(7,), limits=(8, 9))
    assert (one.name, other.name) == ("8-7", "9-7") and other.given["out"] == tmp_path / "9-7"
    found: dict[str, Any] = {}
    push = functools.wraps(cli.push)(lambda **given: found.update(given))
    assert console.run("test", {"push": push, "export": cli.export}, other.words()) == 0
    assert found == other.given and found["data"][0] == pathlib.Path("a").absolute() and found["limit"] == 9


@pytest.mark.slow
def test_a_training_whose_starter_is_lost_saves_and_ends(data: dict[str, pathlib.Path], tmp_path: pathlib.Path) -> None:
    words = ["push", "--data", str(data["push"]), "--out", str(tmp_path), "--steps", "100000", "--batch", "2"]
    program = sweeping._program([[*words, "--check-only"], words])
    with subprocess.Popen(program, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdin and process.stderr
        for line in process.stderr:
            if re.match(r"train dipn: \d+/100000 ", line):
                process.stdin.close()
        assert process.wait() == 130
    assert checkpoint.newest(tmp_path)[1]["step"] > 1  # type: ignore[index]
