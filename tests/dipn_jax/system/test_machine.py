"""Facts about the machine and the sources."""

import pathlib
import platform
import subprocess

import pytest

from dipn_jax.system import machine


def test_a_commit_is_marked_where_a_python_file_differs(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dipn_jax" / "system").mkdir(parents=True)
    monkeypatch.setattr(machine, "__file__", str(tmp_path / "dipn_jax" / "system" / "machine.py"))
    assert machine.commit() == "unknown"
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "x"]):
        subprocess.run([*git, *words], check=True)
    (tmp_path / "page.md").touch()
    clean = machine.commit()
    assert len(clean) == 12 and int(clean, 16) >= 0
    (tmp_path / "dipn_jax" / "new.py").touch()
    assert machine.commit() == f"{clean}-dirty"


def test_a_machine_has_a_processor_and_cores() -> None:
    assert machine.processor() and machine.cores() >= 1


@pytest.fixture
def many(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine of 64 cores."""
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(64))


def _written(path: pathlib.Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize(
    ("files", "group", "count"),
    [
        ({}, None, 64),
        ({"cpu.max": "max 100000\n"}, "0::/\n", 64),
        ({"cpu.max": "250000 100000\n"}, "0::/\n", 2),
        ({"cpu.max": "50000 100000\n"}, None, 1),
        ({"cpu.max": "9900000 100000\n"}, "0::/\n", 64),
        ({"cpu.max": "damaged"}, "0::/\n", 64),
        ({"a/b/cpu.max": "max 100000\n", "a/cpu.max": "300000 100000\n"}, "0::/a/b\n", 3),
        ({"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, None, 4),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, None, 64),
        (
            {"cpu,cpuacct/job/cpu.cfs_quota_us": "500000\n", "cpu,cpuacct/job/cpu.cfs_period_us": "100000\n"},
            "7:cpuset:/\n4:cpu,cpuacct:/job\n",
            5,
        ),
    ],
)
def test_a_containers_quota_is_heeded(
    files: dict[str, str], group: str | None, count: int, many: None, tmp_path: pathlib.Path
) -> None:
    for name, text in files.items():
        _written(tmp_path / "groups" / name, text)
    if group is not None:
        _written(tmp_path / "own" / "cgroup", group)
    assert machine.cores(groups=tmp_path / "groups", own=tmp_path / "own") == count


def test_the_instruction_set_is_the_highest_level_that_the_processor_has(tmp_path: pathlib.Path) -> None:
    info = tmp_path / "cpuinfo"
    for flags, level in (
        ("sse avx avx2 fma avx512f avx512bw avx512cd avx512dq avx512vl", "x86-64-v4"),
        ("sse avx avx2 fma avx512f", "x86-64-v3"),
        ("sse avx", platform.machine().replace("_", "-")),
    ):
        info.write_text(f"processor\t: 0\nmodel name\t: Some\nflags\t\t: {flags}\n\nprocessor\t: 1\n")
        assert machine.instructions(info=info) == level
    assert machine.instructions(info=tmp_path / "nowhere") == platform.machine().replace("_", "-")
