"""What the page on many machines gives to job managers does what the page says."""

import inspect
import pathlib
import re
import signal
import subprocess
import time

import pytest
import yaml
from dipn_jax.datagen import cli

from dipn_jax.storage import accounting

PAGE = pathlib.Path(__file__).parent.parent / "docs" / "howto" / "cluster.md"


def _block(kind: str) -> str:
    (found,) = re.findall(rf"^```{kind}\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    return str(found)


@pytest.mark.parametrize(
    ("sent", "code", "queued"),
    [
        ((), 0, False),
        ((), 2, False),
        ((), 130, False),
        ((signal.SIGUSR1,), 130, True),
        ((signal.SIGTERM,), 130, False),
        ((signal.SIGUSR1, signal.SIGTERM), 130, False),
        ((signal.SIGUSR1,), 0, False),
    ],
)
def test_the_script_of_an_array_queues_again_what_its_time_limit_stops_and_not_what_is_cancelled(
    sent: tuple[signal.Signals, ...], code: int, queued: bool, tmp_path: pathlib.Path
) -> None:
    """With a job manager and a worker that only say what they are told; this ends at the last signal.

    The shell is made slow where it has begun the worker, so that the first signal finds it there.
    """
    script = _block("sh").replace(" &\n", " &\nsleep 0.3\n")
    assert script.count("sleep") == 1
    assert "#SBATCH --requeue" in script and "#SBATCH --signal=B:USR1@120" in script
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    hears = f"trap 'echo >> heard; [ $(wc -l < heard) -lt {len(sent)} ] || exit {code}' TERM"
    waits = "for i in $(seq 600); do sleep 0.05; done" if sent else ""
    for path, text in (
        (programs / "dipn-datagen", f'{hears}\necho "$@" > begun\n{waits}\nexit {code}'),
        (tmp_path / "scontrol", 'echo "$@" > queued'),
    ):
        path.write_text(f"#!/bin/bash\n{text}\n")
        path.chmod(0o755)
    (tmp_path / "job.sh").write_text(script)
    known = {"SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "3", "SLURM_CPUS_PER_TASK": "4"}
    job = subprocess.Popen(["bash", "job.sh"], cwd=tmp_path, env=known | {"PATH": f"{tmp_path}:/usr/bin:/bin"})
    _wait_for_lines(tmp_path / "begun", 1)
    for number, each in enumerate(sent, 1):
        job.send_signal(each)
        _wait_for_lines(tmp_path / "heard", number)
    assert job.wait(timeout=60) == code
    assert "--shard 3 --of 200 --threads 4 --engine native" in (tmp_path / "begun").read_text()
    assert (tmp_path / "queued").exists() == queued
    assert not queued or (tmp_path / "queued").read_text() == "requeue 7_3\n"


def _wait_for_lines(path: pathlib.Path, lines: int) -> None:
    until = time.monotonic() + 60
    while not path.exists() or path.read_text().count("\n") < lines:
        assert time.monotonic() < until, f"{path.name} has no {lines} lines"
        time.sleep(0.01)


def test_an_array_has_a_task_for_each_worker_and_a_shard_for_each_task() -> None:
    """Jobs of SLURM and Kubernetes: a task fewer than workers leaves shards missing, and no task says so."""
    script, job = _block("sh"), yaml.safe_load(_block("yaml"))
    first, last = map(int, re.findall(r"--array=(\d+)-(\d+)", script)[0])
    (of,) = map(int, re.findall(r"--of (\d+)", script))
    (episodes,) = map(int, re.findall(r"--episodes (\d+)", script))
    assert (first, last) == (0, of - 1) and job["spec"]["completions"] == of
    shards = accounting.RequestedSize(episodes, inspect.signature(cli.push).parameters["shard_size"].default).shards()
    said = f"are {shards:,} shards, ten for each of {of} workers"
    assert shards == 10 * of and said in " ".join(PAGE.read_text().split())


def test_the_indexed_job_gives_up_an_index_whose_user_is_mistaken() -> None:
    job = yaml.safe_load(_block("yaml"))
    spec = job["spec"]
    pod = spec["template"]["spec"]
    (worker,) = pod["containers"]
    assert (job["kind"], spec["completionMode"], pod["restartPolicy"]) == ("Job", "Indexed", "Never")
    assert "backoffLimitPerIndex" in spec, "without it, an index cannot fail by itself"
    rules = {rule["action"]: rule for rule in spec["podFailurePolicy"]["rules"]}
    assert rules["FailIndex"]["onExitCodes"] == {"operator": "In", "values": [2]}
    assert next(iter(rules)) == "Ignore" and rules["Ignore"]["onPodConditions"] == [{"type": "DisruptionTarget"}]
    assert f"--of={spec['completions']}" in worker["args"] and "--shard=$(JOB_COMPLETION_INDEX)" in worker["args"]
    mounted = {mount["name"] for mount in worker["volumeMounts"]}
    assert mounted == {volume["name"] for volume in pod["volumes"]}
