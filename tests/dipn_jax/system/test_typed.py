"""What is read back is parsed and checked in one place, and what does not fit is said in one line."""

import pathlib
from typing import Any

import pytest

from dipn_jax.system import typed

FORM = {
    "kind": {"push", "grasp"},
    "shards": {str: {"bytes": typed.Whole(1, 100), "note?": str}},
    "size": (float, float),
    "steps": [int],
    "seed": typed.Maybe(int),
}
GOOD: dict[str, Any] = {
    "kind": "push",
    "shards": {"a": {"bytes": 3, "more": []}},
    "size": [1, 2.5],
    "steps": [1, 2],
    "seed": None,
}


def test_what_fits_is_returned_as_it_is() -> None:
    assert typed.check(GOOD, FORM) is GOOD


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("kind", "poke", "kind is poke, want one of grasp, push"),
        ("kind", ["push"], "kind is a list of 1, want one of"),
        ("shards", [], "shards is a list of 0, want an object"),
        ("shards", {"a": {}}, "shards.a.bytes is missing"),
        ("shards", {"a": {"bytes": 0}}, "shards.a.bytes is 0, want a whole number, 1 to 100"),
        ("shards", {"a": {"bytes": True}}, "shards.a.bytes is true, want a whole number"),
        ("shards", {"a": {"bytes": 1, "note": "\ud800"}}, r"shards.a.note is \\ud800, want text"),
        ("size", [1], "size is a list of 1, want a list of 2"),
        ("size", [1, float("nan")], r"size\[1\] is NaN, want a finite number"),
        ("size", ["1", 2], r"size\[0\] is 1, want a finite number"),
        ("steps", [1, 1.0], r"steps\[1\] is 1.0, want a whole number"),
        ("steps", [2**70], r"steps\[0\] is a number of many digits, want a whole number"),
        ("seed", "x" * 99, r"seed is x{57}\.\.\., want"),
        ("seed", "a\nb", r"seed is a\?b, want"),
    ],
)
def test_what_does_not_fit_is_said_in_one_line(key: str, value: Any, said: str) -> None:
    with pytest.raises(typed.Misfit, match=said) as caught:
        typed.check(GOOD | {key: value}, FORM)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"\xff{}",
        b"{" * 9,
        b"[" * 100_000,
        b"[NaN]",
        b"[1e999]",
        b"[-Infinity]",
        b"9" * 5000,
        '{"a":\n\n1 2}',
        b"\0",
        '{"a": 1, "b": {"c": 1, "c": 1}}',
    ],
)
def test_what_is_no_json_is_said_in_one_line(text: str | bytes) -> None:
    with pytest.raises(typed.Misfit, match="not JSON") as caught:
        typed.parse(text)
    assert "\n" not in str(caught.value)


def test_json_is_parsed_with_or_without_a_byte_order_mark() -> None:
    assert typed.parse(b'\xef\xbb\xbf{"a": [1, 2.5, "\xc3\xa4"]}') == typed.parse('{"a": [1, 2.5, "\u00e4"]}')


@pytest.mark.parametrize("name", ["", "/etc/hosts", "../x", "a/../../x", "..", "\0", "a\\b", "x" * 5000, "\udc80"])
def test_names_do_not_lead_out_of_a_folder(tmp_path: pathlib.Path, name: str) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "x").touch()
    with pytest.raises(typed.Misfit, match="is no file inside"):
        typed.inside(tmp_path / "in", name)


def test_names_inside_a_folder_are_paths(tmp_path: pathlib.Path) -> None:
    (tmp_path / "other").symlink_to(tmp_path)
    assert typed.inside(tmp_path, "a/b.txt") == tmp_path / "a" / "b.txt"
    assert typed.inside(tmp_path / "other", "a") == tmp_path / "other" / "a", "the folder itself may be a link"
    (tmp_path / "link").symlink_to(tmp_path.parent / "x")
    assert typed.inside(tmp_path, "link") == tmp_path / "link", "and the file"
