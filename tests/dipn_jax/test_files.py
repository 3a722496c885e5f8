"""Text files: UTF-8 with or without a byte-order mark, whatever the locale says."""

import json
import os
import pathlib
import subprocess
import sys

import pytest

from dipn_jax import files
from dipn_jax.storage import records
from dipn_jax.world import cases

SCRIPT = """
import os, pathlib, sys
from dipn_jax.eval import cli
from dipn_jax import console, files
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
    manifest = data["images"] / records.MANIFEST
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
