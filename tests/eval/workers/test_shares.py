"""Evaluations that several workers share end as those of one."""

import functools
import json
import pathlib
import shlex
import shutil
from collections.abc import Callable
from typing import Any

import pytest
from dipn_jax.eval import cli
from dipn_jax.eval.clearing import lockstep
from dipn_jax.eval.prediction import push_errors
from dipn_jax.eval.workers import merging, shares
from dipn_jax.eval.workers.shares import Share

from dipn_jax.commands import console
from dipn_jax.commands.launch import LOCAL, Launch
from dipn_jax.errors import UserError

WORDS = {
    "clear": ("--method", "gn", "--grasp-net", "grasp", "--cases", "random", "--objects", "1:2", "--instances", "3",
              "--aids", "memory"),
    "grasp": ("--grasp-net", "grasp", "--scenes", "3", "--objects", "1", "--others", "1", "--aids"),
    "sweep": ("--push-net", "dipn", "--grasp-net", "grasp", "--cases", "random", "--objects", "1", "--instances", "3",
              "--distances", "0.05:0.05:0.01", "--candidates", "2", "--pushes", "3", "--aids"),
    "prediction": ("--push-net", "dipn", "--scenes", "5", "--objects", "1:2", "--no-physics"),
}  # fmt: skip
"""Small evaluations, and the networks that they need."""
OF = 2
"""Workers that share one."""


def _run(*words: object) -> int:
    return console.run("test", cli.COMMANDS, [str(word) for word in words])


@pytest.fixture(scope="module")
def evaluated(
    tiny: dict[str, pathlib.Path], tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., list[pathlib.Path]]:
    """Return what makes, each once, shards of an evaluation, all if none are named; None: the whole by one worker."""
    root = tmp_path_factory.mktemp("shares")

    def make(kind: str, *shards: int | None) -> list[pathlib.Path]:
        return [_made(root / kind, kind, shard, tiny) for shard in shards or range(OF)]

    return make


def _made(root: pathlib.Path, kind: str, shard: int | None, tiny: dict[str, pathlib.Path]) -> pathlib.Path:
    folder = root / ("whole" if shard is None else f"part-{shard}-of-{OF}")
    share = [] if shard is None else ["--shard", shard, "--of", OF, "--threads", 1]
    if not folder.exists():
        words = [kind, *(str(tiny.get(word, word)) for word in WORDS[kind]), "--engine", "native"]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(push_errors, "GROUP", 2)
            assert _run(*words, *share, "--out", folder) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("kind", WORDS)
def test_parts_make_the_very_evaluation_of_one_worker(
    kind: str, evaluated: Callable[..., list[pathlib.Path]], tmp_path: pathlib.Path
) -> None:
    assert _run("merge", *reversed(evaluated(kind)), "--out", tmp_path / "merged") == 0
    (whole,), merged = evaluated(kind, None), tmp_path / "merged"
    names = sorted(str(path.relative_to(whole)) for path in whole.rglob("*") if path.is_file())
    assert names == sorted(str(path.relative_to(merged)) for path in merged.rglob("*") if path.is_file())
    assert "metrics.json" in names and (kind == "prediction" or any("episodes/002.npz" in name for name in names))
    for name in names:
        if not name.endswith(("settings.json", ".png")):
            assert (merged / name).read_bytes() == (whole / name).read_bytes(), name
    settings = [json.loads((place / "settings.json").read_text()) for place in (whole, merged)]
    assert settings[0] | {"out": ""} == settings[1] | {"out": ""} and settings[1]["out"] == str(merged)


def test_a_part_that_is_there_is_not_made_again_and_another_is_refused(
    evaluated: Callable[..., list[pathlib.Path]], tiny: dict[str, pathlib.Path], capfd: pytest.CaptureFixture[str]
) -> None:
    (part,) = evaluated("clear", 0)
    before = {path: path.stat().st_mtime_ns for path in part.rglob("*")}
    words = ["clear", *(str(tiny.get(word, word)) for word in WORDS["clear"]), "--engine", "native", "--out", part]
    assert _run(*words, "--shard", 0, "--of", OF) == 0
    assert "shard 0 of 2 is there already" in capfd.readouterr().out
    assert _run(*words, "--shard", 1, "--of", OF) == 2
    assert "holds another part of an evaluation; give another --out" in capfd.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in part.rglob("*")} == before


@pytest.mark.slow
def test_a_part_of_a_sweep_has_a_part_for_each_distance(
    evaluated: Callable[[str], pathlib.Path],
    tiny: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """These are not made again where the whole part was not ended, and cannot be merged alone."""
    first, second = evaluated("sweep")
    assert _run("merge", first / "0.05", second / "0.05", "--out", tmp_path / "out") == 2
    assert "of one distance only (names is missing); give the folder of the whole part" in capfd.readouterr().err
    begun = pathlib.Path(shutil.copytree(first, tmp_path / "begun"))
    (begun / shares.PART).unlink()
    monkeypatch.setattr(lockstep, "clear", None)
    words = ["sweep", *(str(tiny.get(word, word)) for word in WORDS["sweep"]), "--engine", "native", "--out", begun]
    assert _run(*words, "--shard", 0, "--of", OF) == 0
    assert (begun / shares.PART).read_text() == (first / shares.PART).read_text().replace(str(first), str(begun))
    film = next((begun / "chosen" / "episodes").iterdir())
    film.write_bytes(b"")
    assert _run("merge", begun, second, "--out", tmp_path / "out") == 2
    assert f"{film}: missing, or damaged since it was written" in capfd.readouterr().err
    assert _run(*words[:-1], tmp_path / "out", "--shard", 0, "--of", 4) == 2
    assert "--of 4: more workers than --pushes 3; want at most 3, or --pushes 0" in capfd.readouterr().err


def _edited(part: pathlib.Path, out: pathlib.Path, change: dict[str, Any]) -> pathlib.Path:
    """Return a copy of a part that says something else of itself."""
    shutil.copytree(part, out)
    kept = json.loads((out / shares.PART).read_text())
    (out / shares.PART).write_text(json.dumps(kept | change))
    return out


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"named": {"seed": "1"}}, "aids="),
        ({"named": None}, "made with seed=1000000 and seed=7"),
        ({"content": ["other"]}, "different networks or case files"),
        ({"code": "other"}, "different sources or versions of packages"),
        ({"kind": "grasp"}, "parts of dipn-eval clear and of dipn-eval grasp"),
        ({"of": 3}, "shards of 2 and of 3 workers"),
        ({"shard": 0}, "both are shard 0 of 2; give each part once"),
        ({"format": 9}, "format 9, want 1"),
        ({"shard": 5}, "damaged, shard 5 of 2"),
        ({"command": 3}, "command is 3, want a list"),
        ({"files": {"../x": ""}}, "is no file inside"),
        ({"files": {}}, "lists no episodes.json"),
        ({"kind": "grasp", "about": {"others": 0, "online": None}, "both": True}, "lists no tried.npz"),
        ({"kind": "grasp", "both": True}, "others is missing"),
        ({"kind": "bananas", "both": True}, "bananas: parts of no command"),
    ],
)
def test_what_does_not_belong_together_is_one_line(
    change: dict[str, Any],
    says: str,
    evaluated: Callable[..., list[pathlib.Path]],
    tmp_path: pathlib.Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    first, second = evaluated("clear")
    capfd.readouterr()
    both = change.pop("both", False)
    if change.get("named", "") is None:
        change["named"] = shares.read(second).named | {"seed": "7"}
    edited = _edited(second, tmp_path / "second", change)
    if both:
        first = _edited(first, tmp_path / "first", change)
    assert _run("merge", first, edited, "--out", tmp_path / "out") == 2
    said = capfd.readouterr().err
    assert says in said and said.startswith("error: ") and said.count("\n") == 1
    assert not (tmp_path / "out" / "metrics.json").exists()


def test_a_damaged_file_of_a_part_is_named(
    evaluated: Callable[..., list[pathlib.Path]], tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    first, second = evaluated("clear")
    damaged = _edited(second, tmp_path / "second", {})
    film = next((damaged / "episodes").iterdir())
    film.write_bytes(film.read_bytes()[:-1])
    assert _run("merge", first, damaged, "--out", tmp_path / "out") == 2
    assert f"{film}: missing, or damaged since it was written" in capfd.readouterr().err
    assert _run("merge", first, tmp_path, "--out", tmp_path / "out") == 2
    assert f"{tmp_path}: no part of an evaluation" in capfd.readouterr().err
    assert _run("merge", "--out", tmp_path / "out") == 2
    assert "nothing to merge" in capfd.readouterr().err


def _asked(words: list[str]) -> dict[str, Any]:
    """Return the options of a command without running it."""
    found: list[dict[str, Any]] = []
    command = functools.wraps(cli.COMMANDS[words[0]])(lambda **given: found.append(given))
    assert console.run("test", {words[0]: command, "other": merging.merge}, words) == 0
    return found[0]


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind != "clear")) for kind in WORDS])
def test_a_missing_part_is_named_with_the_command_that_makes_it(
    kind: str,
    evaluated: Callable[..., list[pathlib.Path]],
    tiny: dict[str, pathlib.Path],
    tmp_path: pathlib.Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    only = pathlib.Path(shutil.copytree(*evaluated(kind, 1), tmp_path / "part-1-of-2"))
    capfd.readouterr()
    assert _run("merge", only, "--out", tmp_path / "out") == 2
    said = capfd.readouterr().err
    assert said.startswith("error: shard 0 of 2 missing: run `dipn-eval ") and said.count("\n") == 1
    named = shlex.split(said.split("`")[1])[1:]
    asked = [kind, *(str(tiny.get(word, word)) for word in WORDS[kind]), "--engine", "native"]
    share = ["--shard", "0", "--of", "2", "--out", str(tmp_path / "part-0-of-2")]
    assert named[-6:] == share and _asked(named) == _asked([*asked, *share])


def test_shares_that_make_no_sense_are_refused() -> None:
    for given, says in (
        ((2, 2), "--shard 2 --of 2: want 0 <= shard < of"),
        ((0, 0), "--of 0"),
    ):
        with pytest.raises(UserError, match=says):
            Share(*given)
    for share, launch, says in (
        (Share(None, 2), LOCAL, "--of 2: give --shard, too"),
        (Share(0, 2), Launch("ray"), "give --of, their number, 2 or more, and no --shard"),
        (Share(), Launch("ray"), "give --of, their number, 2 or more, and no --shard"),
    ):
        with pytest.raises(UserError, match=says):
            share.check(launch)
    with pytest.raises(UserError, match="--of 4: more workers than the 3 that can be shared"):
        Share(0, 4).rows(3)
    assert [list(Share(shard, 3).rows(7)) for shard in range(3)] == [[0, 3, 6], [1, 4], [2, 5]]
    assert list(Share().rows(3)) == [0, 1, 2]


def test_other_processors_are_said(
    evaluated: Callable[..., list[pathlib.Path]], tmp_path: pathlib.Path, capfd: pytest.CaptureFixture[str]
) -> None:
    first, second = evaluated("clear")
    other = _edited(second, tmp_path / "second", {"processor": "Abacus"})
    merging.together([shares.read(first), shares.read(other)], tmp_path / "out")
    said = capfd.readouterr().err
    assert "parts were made by different versions or kinds of processor" in said and "Abacus" in said
