"""What a command is started with: the environment, closed streams, terminals without room."""

import os
import pathlib
import subprocess
import sys

import pytest

from dipn_jax.commands import console, surroundings
from dipn_jax.errors import UserError
from dipn_jax.storage import shards
from dipn_jax.system import files


def _does(script: str, *, closed: str = "", **environment: str) -> tuple[int, str, str]:
    """Run a script as the work of a command that was started so; return exit code, output and errors."""
    text = (
        "import sys\nfrom dipn_jax.commands import console\n"
        f"def work() -> None:\n    '''Work.'''\n    {script}\n"
        "sys.exit(console.run('test', {'work': work, 'other': work}, sys.argv[1:] or ['work']))"
    )
    words = ["sh", "-c", f'"$0" -c "$1" {closed}', sys.executable, text]
    done = subprocess.run(words, capture_output=True, env=os.environ | environment, check=False, timeout=60)
    return done.returncode, done.stdout.decode(), done.stderr.decode()


def test_settings_that_change_numbers_are_ignored_with_one_line() -> None:
    script = "import jax; print(jax.config.jax_enable_x64, jax.config.jax_random_seed_offset)"
    code, out, error = _does(script, JAX_ENABLE_X64="1", JAX_RANDOM_SEED_OFFSET="7")
    assert (code, out) == (0, "False 0\n")
    assert error == (
        "warning: JAX_ENABLE_X64=1, JAX_RANDOM_SEED_OFFSET=7: ignored, because results would differ or fail\n"
    )


def test_a_setting_that_jax_does_not_know_is_one_line() -> None:
    code, _, error = _does("import jax", JAX_ENABLE_CHECKS="perhaps")
    assert code == 2 and error.count("\n") == 1
    assert error.startswith("error: JAX_ENABLE_CHECKS=perhaps: JAX cannot be imported (invalid truth value 'perhaps'")


def test_a_display_is_not_asked_for() -> None:
    assert _does("import mujoco; print(mujoco.mj_version() > 0)", MUJOCO_GL="bananas") == (0, "True\n", "")


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_stream_that_is_closed_is_put_up_with(closed: str, tmp_path: pathlib.Path) -> None:
    """And no file gets what is printed."""
    path = tmp_path / "file"
    script = f"file = open({str(path)!r}, 'w'); print('a'); print('b', file=sys.stderr, flush=True); file.close()"
    assert _does(script, closed=closed)[0] == 0
    assert path.read_bytes() == b""


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full here")
def test_where_an_error_cannot_be_printed_its_code_is_kept() -> None:
    assert _does("raise OSError(28, 'no space')", closed="2>/dev/full")[0] == 2


def test_output_takes_any_name_whatever_its_encoding() -> None:
    script = "console.say('\\u65e5 \\udcff')"
    assert _does(script, PYTHONIOENCODING="latin-1")[:2] == (0, "\\u65e5 \\udcff\n")
    assert _does("console.say('\\u65e5')", PYTHONIOENCODING="utf-8")[:2] == (0, "\u65e5\n")


def test_a_terminal_without_room_gets_help_that_is_wide_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "1")
    surroundings.set_environment()
    assert int(os.environ["COLUMNS"]) == surroundings.NARROWEST
    monkeypatch.setenv("COLUMNS", "100")
    surroundings.set_environment()
    assert os.environ["COLUMNS"] == "100"


def test_a_name_that_is_no_utf8_is_refused_before_anything_is_written(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UserError, match=r"x\\udcff: a name that is not UTF-8"):
        files.absolute("x\udcff")

    def named(out: pathlib.Path) -> None:
        """Make a folder."""
        out.mkdir()

    assert console.run("test", {"named": named, "other": named}, ["named", "--out", "x\udcff"]) == 2
    assert capfd.readouterr().err.count("\n") == 1 and not os.path.exists("x\udcff")


def test_shards_are_read_where_the_locale_knows_no_umlauts(
    data: dict[str, pathlib.Path], tmp_path: pathlib.Path
) -> None:
    """Their names are then surrogates in Python, which Arrow would not take."""
    there = tmp_path / "Läufe"
    there.symlink_to(data["images"])
    name = shards.shard_path(there, 0).name
    environment = os.environ | {"PYTHONUTF8": "0", "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}
    script = (
        "import os, pathlib, sys; from dipn_jax.storage import shards; from dipn_jax.system import files\n"
        "print(shards.count(pathlib.Path(sys.argv[1])))\n"
        "try: files.require_locale(pathlib.Path(sys.argv[1]))\n"
        "except files.UserError as error: print(error)"
    )
    words = [sys.executable, "-c", script, str(there / name)]
    done = subprocess.run(words, capture_output=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    counted, said = done.stdout.decode().splitlines()
    assert int(counted) == shards.count(there / name) and "set PYTHONUTF8=1" in said
    files.require_locale(there)
