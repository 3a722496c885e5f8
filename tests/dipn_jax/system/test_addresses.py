"""URLs are told from paths, pass through the command line as they are, and stand in what the user reads."""

import pathlib
from typing import Any

import pytest

from dipn_jax.commands import console, launch
from dipn_jax.errors import UserError
from dipn_jax.system import addresses
from dipn_jax.system.addresses import Place


@pytest.mark.parametrize(
    "given",
    ["s3://bucket/data/push", "s3://bucket", "gs://bucket/a b", "az://container/x", "file:///tmp/x", "file:///a%20b"],
)
def test_a_url_is_itself_again_after_it_was_a_path(given: str) -> None:
    assert addresses.url(pathlib.Path(given)) == addresses.url(given) == given
    assert addresses.url(f"{given}/") == given


@pytest.mark.parametrize("given", ["data", "/s3:/bucket", "a/s3://b", "s3", "s3x://bucket", "builtin", "~/gs:"])
def test_a_path_is_no_url(given: str) -> None:
    assert addresses.url(pathlib.Path(given)) is None


def test_options_of_data_sets_take_urls_and_others_refuse_them(
    capsys: pytest.CaptureFixture[str], tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given: list[Any] = []

    def both(data: tuple[Place, ...], out: pathlib.Path = tmp_path) -> None:
        """Take data sets and a folder."""
        given.extend([data, out])

    commands = {"both": both, "other": both}
    assert console.run("test", commands, ["both", "--data", "s3://bucket/data", "here", "--out", "there"]) == 0
    (url, path), out = given
    assert addresses.url(url) == "s3://bucket/data" and (path, out) == (tmp_path / "here", tmp_path / "there")
    assert console.run("test", commands, ["both", "--data", "here", "--out", "s3://bucket/run"]) == 2
    said = "error: s3://bucket/run: a URL, which this option does not take; give a path\n"
    assert capsys.readouterr().err == said and len(given) == 2


def test_lines_name_a_copy_by_its_url(capsys: pytest.CaptureFixture[str], tmp_path: pathlib.Path) -> None:
    addresses.show_instead(tmp_path, "s3://bucket/data")
    console.say(f"{tmp_path / 'x'}: whole")
    console.warn(f"run `dipn-datagen repair {tmp_path}`")
    output = capsys.readouterr()
    assert output.out == "s3://bucket/data/x: whole\n"
    assert output.err == "warning: run `dipn-datagen repair s3://bucket/data`\n"


def test_a_task_says_the_url_of_its_copy(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has names of its own, which the command that gets its line does not know."""
    addresses.show_instead(tmp_path, "s3://bucket/data")

    def failing(error: Exception) -> None:
        raise error

    monkeypatch.setenv(launch.PREALLOCATE, "false")
    for error, says in (
        (UserError(f"{tmp_path}: begun"), "s3://bucket/data: begun"),
        (OSError(28, "No space left", str(tmp_path)), "s3://bucket/data: No space left; mend that and try again"),
    ):
        ended = launch._attempt(failing, (error,), True)
        assert ended.result is None and ended.trouble is None and str(ended.mistake).endswith(says)
        assert str(tmp_path) not in str(ended.mistake)
