"""What the page on many machines gives to job managers does what the page says."""

import pathlib
import re
import signal
import subprocess
import time

import pytest
import yaml

PAGE = pathlib.Path(__file__).parent.parent / "docs" / "howto" / "cluster.md"


def _block(kind: str) -> str:
    (found,) = re.findall(rf"^```{kind}\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    return str(found)


@pytest.mark.parametrize(("stopped", "code"), [(False, 0), (False, 2), (True, 130)])
def test_the_script_of_an_array_hands_signals_on_and_queues_again_what_was_interrupted(
    stopped: bool, code: int, tmp_path: pathlib.Path
) -> None:
    """With a worker and a job manager that only say what they are told."""
    script = _block("sh")
    assert "#SBATCH --requeue" in script and "#SBATCH --signal=B:TERM@120" in script
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    waits = "for i in $(seq 600); do sleep 0.05; done" if stopped else ""
    for path, text in (
        (programs / "dipn-datagen", f"trap 'exit 130' TERM\necho \"$@\" > begun\n{waits}\nexit {code}"),
        (tmp_path / "scontrol", 'echo "$@" > queued'),
    ):
        path.write_text(f"#!/bin/bash\n{text}\n")
        path.chmod(0o755)
    (tmp_path / "job.sh").write_text(script)
    known = {"SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "3", "SLURM_CPUS_PER_TASK": "4"}
    job = subprocess.Popen(["bash", "job.sh"], cwd=tmp_path, env=known | {"PATH": f"{tmp_path}:/usr/bin:/bin"})
    while not (tmp_path / "begun").exists() or not (tmp_path / "begun").read_text():
        time.sleep(0.01)
    if stopped:
        job.send_signal(signal.SIGTERM)
    assert job.wait(timeout=60) == code
    assert "--shard 3 --of 1000 --threads 4" in (tmp_path / "begun").read_text()
    assert (tmp_path / "queued").exists() == stopped
    assert not stopped or (tmp_path / "queued").read_text() == "requeue 7_3\n"


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
