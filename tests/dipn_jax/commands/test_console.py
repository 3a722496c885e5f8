"""What the commands share: paths as users give them."""

import functools
import pathlib
from typing import Any

import pytest
from dipn_jax.datagen import cli as datagen_cli
from dipn_jax.eval import cli as eval_cli
from dipn_jax.eval.clearing.tables import Tables
from dipn_jax.train import cli as train_cli

import dipn_jax
from dipn_jax.commands import console
from dipn_jax.errors import UserError
from dipn_jax.storage import resume
from dipn_jax.system import addresses, files
from dipn_jax.world import cases

EVERY = {
    f"{stage.__name__}.{name}": (stage.COMMANDS, name, command)
    for stage in (datagen_cli, train_cli, eval_cli)
    for name, command in stage.COMMANDS.items()
}


@pytest.fixture
def home(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    """A home folder of its own, and another folder as the one that we are in."""
    (tmp_path / "home").mkdir()
    (tmp_path / "here").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "home"


def _paths(value: Any) -> list[pathlib.Path]:
    return [value] if isinstance(value, pathlib.Path) else [p for v in value for p in _paths(v)] if value else []


@pytest.mark.parametrize("which", EVERY)
def test_every_path_of_every_command_is_absolute_when_it_begins(
    which: str, home: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands, name, command = EVERY[which]
    hints = {key: str(kind) for key, kind in command.__annotations__.items()}
    wanted = {key: kind for key, kind in hints.items() if "pathlib.Path" in kind or "Place" in kind}
    assert wanted
    seen: dict[str, Any] = {}

    def called(*positional: Any, **named: Any) -> None:
        seen.update(dict(zip(hints, positional, strict=False)) | named)

    called.__dict__.update(__doc__=command.__doc__, __wrapped__=command)
    arguments = [name]
    for key, kind in wanted.items():
        shown = {"clears": "clear", "predictions": "prediction", "grasps": "grasp", "sweeps": "sweep"}.get(key, key)
        option = [] if "Positional" in kind else [f"--{shown.replace('_', '-')}"]
        arguments += [*option, "~/lit", *(["there/x"] if "tuple" in kind else [])]
    given = commands | {name: called}
    assert console.run("test", given, arguments) == 0
    for key, kind in wanted.items():
        expected = [home / "lit", *([pathlib.Path.cwd() / "there" / "x"] if "tuple" in kind else [])]
        assert _paths(seen[key]) == expected, key
    urls = ["s3://bucket/x" if word == "~/lit" else word for word in arguments]
    places = {key for key, kind in wanted.items() if "Place" in kind}
    assert console.run("test", given, urls) == (0 if places == wanted.keys() else 2)
    if places == wanted.keys():
        assert all(addresses.url(_paths(seen[key])[0]) == "s3://bucket/x" for key in places)


def test_builtin_is_a_name_and_stays_one(home: pathlib.Path) -> None:
    assert files.with_absolute_paths(pathlib.Path("builtin")) == pathlib.Path("builtin")
    assert files.with_absolute_paths(Tables("random")) == Tables("random")


def test_a_home_that_is_not_there_is_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    command = ["info", "~nobody-of-that-name/data"]
    assert console.run("test", datagen_cli.COMMANDS, command) == 2
    error = capfd.readouterr().err
    assert error == f"error: {command[1]}: there is no home folder for ~; give the folder's full path\n"


@pytest.mark.parametrize(
    ("commands", "words", "named"),
    [
        (train_cli, ["push", "--data", "x", "--out", ""], "--out "),
        (train_cli, ["push", "--data", "x", "--out="], "--out "),
        (train_cli, ["push", "--data", "x", "--out", "y", "--init", ""], "--init "),
        (train_cli, ["push", "--data", "x", "--out", "y", "--profile", ""], "--profile "),
        (train_cli, ["grasp", "--data", "", "--out", "y"], "--data "),
        (datagen_cli, ["info", ""], ""),
        (datagen_cli, ["merge", "x", "", "--out", "y"], ""),
        (eval_cli, ["clear", "--out", "y", "--cases", ""], ""),
    ],
)
def test_an_empty_path_is_not_the_folder_that_we_are_in(
    commands: Any, words: list[str], named: str, home: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert console.run("test", commands.COMMANDS, words) == 2
    assert capfd.readouterr().err.startswith(f"error: {named}'': an empty path")
    assert not list(pathlib.Path.cwd().iterdir())


def test_a_function_takes_no_empty_path_either() -> None:
    network = functools.partial(dipn_jax.load_network, network="dipn")
    for call in (network, dipn_jax.load_cases, dipn_jax.read_episodes, files.absolute):
        with pytest.raises(UserError, match=r"^'': an empty path"):
            call("")
    assert files.absolute(".") == files.absolute(pathlib.Path()) == pathlib.Path.cwd()


def test_a_user_without_a_home_has_no_cache_and_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    console.enable_compilation_cache()


def test_a_case_file_is_found_below_home(home: pathlib.Path) -> None:
    (home / "mine.json").write_bytes(cases.hard_cases_path().read_bytes())
    tables = Tables("~/mine.json")
    assert tables.path() == home / "mine.json" and tables.slots() == 6
    assert len(cases.load_cases("~/mine.json")[0]) == 10
    with pytest.raises(UserError, match=str(home / "gone")):
        files.read_json(files.absolute("~/gone"))


def test_unfinished_work_continues_when_its_folders_have_moved(tmp_path: pathlib.Path) -> None:
    """Unfinished work is known by what its paths lead to, not by their names."""
    before = {name: pathlib.Path(name) for name in ("out", "grasp_net", "tables.cases")} | {"seed": 3}
    now = {"out": tmp_path, "grasp_net": tmp_path / "gn", "seed": 3, "tables.cases": tmp_path / "mine.json"}
    resume.Partial(tmp_path, before).save("half")
    assert resume.Partial(tmp_path, now).load(None) == "half"
    assert resume.Partial(tmp_path, now | {"seed": 4}).load(None) is None
    resume.Partial(tmp_path, now).save("more")
    assert resume.Partial(tmp_path, now | {"out": tmp_path / "moved"}).load(None) == "more"
