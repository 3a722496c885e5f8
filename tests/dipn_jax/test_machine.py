"""Facts about the machine and the sources."""

import pathlib
import subprocess

import pytest

from dipn_jax import machine


def test_a_commit_is_marked_where_a_python_file_differs(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dipn_jax").mkdir()
    monkeypatch.setattr(machine, "__file__", str(tmp_path / "dipn_jax" / "machine.py"))
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
