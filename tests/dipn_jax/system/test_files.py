"""Text files: UTF-8 with or without a byte-order mark, whatever the locale says."""

import errno
import json
import os
import pathlib
import stat
import subprocess
import sys

import pytest

import dipn_jax
from dipn_jax.errors import UserError
from dipn_jax.storage import arrays, records, shards
from dipn_jax.storage.manifest import MANIFEST
from dipn_jax.system import files, typed
from dipn_jax.world import cases

SCRIPT = """
import os, pathlib, sys
from dipn_jax.eval import cli
from dipn_jax.commands import console
from dipn_jax.system import files
from dipn_jax.world import cases

def named(folder: pathlib.Path) -> None:
    '''Say the names in a case file, and keep them.'''
    names = cases.load_cases(folder / os.fsdecode(b"f\\xc3\\xa4lle.json"))[0]
    console.say(f"{folder}: {names[0]}")
    files.write_text(folder / "report.md", f"{folder.name}: {names[0]}")
    files.write_json(folder / "report.json", names[:1])

sys.exit(console.run("test", {"named": named}, ["--folder", sys.argv[1]]))
"""


def _marked(path: pathlib.Path) -> None:
    """Put a byte-order mark before a file."""
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())


def test_names_with_umlauts_where_the_locale_knows_none(tmp_path: pathlib.Path) -> None:
    folder = tmp_path / "Läufe"
    folder.mkdir()
    text = cases.hard_cases_path().read_text(encoding="utf-8")
    first = json.loads(text)["cases"][0]
    (folder / "fälle.json").write_text(
        json.dumps({"cases": [first | {"name": "Tür"}]}, ensure_ascii=False), encoding="utf-8"
    )
    environment = os.environ | {"PYTHONUTF8": "0", "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}
    environment.pop("PYTHONIOENCODING", None)
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder)], capture_output=True, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout.decode("utf-8") == f"{folder}: Tür\n"
    assert (folder / "report.md").read_text(encoding="utf-8") == "Läufe: Tür"
    assert files.read_json(folder / "report.json", wanted=list) == ["Tür"]


def test_a_byte_order_mark_is_read_over(tmp_path: pathlib.Path, data: dict[str, pathlib.Path]) -> None:
    mine = tmp_path / "mine.json"
    mine.write_bytes(cases.hard_cases_path().read_bytes())
    _marked(mine)
    assert cases.load_cases(mine)[0] == cases.load_cases()[0]
    assert list(files.read_json(mine))
    manifest = data["images"] / MANIFEST
    before = manifest.read_bytes()
    _marked(manifest)
    try:
        assert records.verify(data["images"]) == []
    finally:
        manifest.write_bytes(before)


def test_a_file_that_is_no_utf8_is_damaged(tmp_path: pathlib.Path) -> None:
    (tmp_path / "a.json").write_bytes('{"name": "Tür"}'.encode("latin-1"))
    with pytest.raises(files.UserError, match="damaged, not JSON"):
        files.read_json(tmp_path / "a.json")


def test_a_folder_that_was_begun_otherwise_is_said_in_one_line(tmp_path: pathlib.Path) -> None:
    files.write_json(tmp_path / "config.json", {"kind": "a\nb" * 200})
    with pytest.raises(files.UserError, match=r"begun with kind=a\?b.*, asked for kind=push") as caught:
        files.claim(tmp_path, {"kind": "push"})
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600


@pytest.mark.parametrize("text", ['{"a": 1}\n[', '{"a": 1}\n{"a": "x"}', '{"a": 1}\n\n{"a": 2}', '{"a": 1}\n3'])
def test_a_line_of_a_log_that_does_not_fit_is_named(text: str, tmp_path: pathlib.Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"a": 1}\n{"a": 2.5}\n')
    assert files.read_lines(path, wanted={"a": float}) == [{"a": 1}, {"a": 2.5}]
    path.write_text(text)
    with pytest.raises(files.UserError, match=r"metrics\.jsonl: damaged, line 2"):
        files.read_lines(path, wanted={"a": float})


def _recorded(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Return a list that fills with what is synced (`sync`, name) and renamed (`rename`, new name), in order."""
    did: list[tuple[str, str]] = []
    sync, rename = os.fsync, pathlib.Path.rename

    def synced(descriptor: int) -> None:
        sync(descriptor)
        did.append(("sync", pathlib.Path(os.readlink(f"/proc/self/fd/{descriptor}")).name))

    def renamed(self: pathlib.Path, target: pathlib.Path) -> pathlib.Path:
        did.append(("rename", target.name))
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(pathlib.Path, "rename", renamed)
    return did


def test_content_is_synced_before_a_rename_and_the_name_after_it(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    did = _recorded(monkeypatch)
    files.write_text(tmp_path / "a.txt", "a")
    assert did[0][0] == "sync" and did[0][1].startswith(".a.txt.")
    assert did[1:] == [("rename", "a.txt"), ("sync", tmp_path.name)]
    did.clear()
    (tmp_path / "new" / "inner").mkdir(parents=True)
    (tmp_path / "new" / "inner" / "b").touch()
    files.move(tmp_path / "new", tmp_path / "old")
    at = did.index(("rename", "old"))
    assert sorted(did[:at]) == [("sync", "b"), ("sync", "inner"), ("sync", "new")]
    assert did[at + 1 :] == [("sync", tmp_path.name)]


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP, errno.EIO])
def test_a_file_system_that_syncs_no_folders_is_put_up_with(
    number: int, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error of another kind is not, and no error of a file."""
    refused = {"folder": True}

    def refuse(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode) == refused["folder"]:
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    if number == errno.EIO:
        with pytest.raises(OSError, match=r"a\.txt"):
            files.write_text(tmp_path / "a.txt", "a")
        return
    files.write_text(tmp_path / "a.txt", "a")
    assert (tmp_path / "a.txt").read_text() == "a"
    refused["folder"] = False
    with pytest.raises(OSError, match=r"b\.txt"):
        files.write_text(tmp_path / "b.txt", "b")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_the_digest_of_the_code_covers_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    covered: list[pathlib.Path] = []
    monkeypatch.setattr(files, "read_bytes", lambda path: covered.append(path) or b"")
    files.code_digest()
    root = pathlib.Path(dipn_jax.__file__).parent
    assert {path for kind in ("*.py", "*.h") for path in root.rglob(kind)} == set(covered)
    assert root / "system" / "files.py" in covered


def test_the_digest_of_the_code_covers_kernels_and_stages(tmp_path: pathlib.Path) -> None:
    found = {files.code_digest(tmp_path)}
    for name in ("a.py", "a.h"):
        (tmp_path / name).write_text("1")
        found.add(files.code_digest(tmp_path))
    (tmp_path / "notes.txt").write_text("1")
    assert len(found) == 3 and files.code_digest(tmp_path) in found


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with a name here")
def test_a_pipe_is_not_waited_for(tmp_path: pathlib.Path) -> None:
    """Reading a pipe that nobody writes to takes for ever; each of these would hang."""
    pipe = tmp_path / "shard-00000.parquet"
    os.mkfifo(pipe)
    for read in (files.read_json, files.read_lines, cases.load_cases, shards.read_meta):
        with pytest.raises(UserError, match=f"{pipe}.*not a regular file"):
            read(pipe)
    for read in (files.read_bytes, files.read_text, files.file_sha256):
        with pytest.raises(OSError, match="not a regular file"):
            read(pipe)
    with pytest.raises(typed.Misfit, match="not a regular file"):
        arrays.read(pipe, {})
