"""The shell commands of pages: their words, and the same commands made small with what they read put in place."""

from __future__ import annotations

import glob
import pathlib
import re
import shlex
import shutil

from experiments import runs

ROOT = pathlib.Path(__file__).parent.parent.parent
SHIPPED = ROOT / "dipn_jax" / "data"
BIN = ".venv/bin/"
SHELL = re.compile(r"^```bash\n(.*?)^```$", re.MULTILINE | re.DOTALL)
VALUES = {
    "--episodes": ("24",), "--steps": ("2",), "--objects": ("1:3",), "--candidates": ("4",), "--scenes": ("2",),
    "--instances": ("1",), "--limit": ("12",), "--limits": ("6", "12"), "--of": ("2",), "--batch": ("4",),
    "--grasps": ("4",), "--actions": ("4",), "--sample": ("4",), "--num-cpus": ("1",), "--at-once": ("1",),
}  # fmt: skip
"""Options that make a command large, and the values of the tests."""
LEARNING = ("--steps", "2", "--batch", "4", "--eval-every", "2", "--save-every", "2")
ACTING = ("--objects", "1:3", "--tables", "2", "--updates", "1", "--batch", "2")
CLEARING = ("--instances", "1", "--candidates", "4")
ALWAYS = {
    ("dipn-datagen", "push"): ("--objects", "1:3", "--episodes", "24", "--shard-size", "24"),
    ("dipn-datagen", "grasp"): ("--objects", "1:3", "--episodes", "24", "--shard-size", "24"),
    ("dipn-datagen", "images"): ("--episodes", "24", "--shard-size", "24"),
    ("dipn-datagen", "check-world"): ("--scenes", "2", "--few", "2", "--tries", "2"),
    ("dipn-train", "push"): LEARNING,
    ("dipn-train", "grasp"): LEARNING,
    ("dipn-train", "grasp-pretrain"): LEARNING,
    ("dipn-train", "grasp-online"): (*ACTING, "--grasps", "4"),
    ("dipn-train", "baseline"): (*ACTING, "--actions", "4"),
    ("dipn-eval", "clear"): CLEARING,
    ("dipn-eval", "sweep"): (*CLEARING, "--pushes", "2"),
    ("dipn-eval", "prediction"): ("--scenes", "2"),
    ("dipn-eval", "grasp"): ("--scenes", "2"),
}  # fmt: skip
"""Options that the tests add to a command which does not have them."""
ONE_CASE = {"hard": "06", "heldout": "vft01"}
"""The only case of a file that the tests clear."""
STAND_INS = {
    "data/push": "push", "data/grasp": "grasp", "data/images": "images", "data/million": "push", "disk1/push": "push",
    "bucket/million": "push", "runs/dipn": "dipn", "runs/gn": "gn", "results/push/runs/51000-0": "dipn",
    "results/grasp/shipped": "gn", "disk2/push": ("dipn-datagen", "push", "--seed", "1"),
    "runs/vpg": ("dipn-train", "baseline", "--method", "vpg"),
}  # fmt: skip
"""What pages expect to be there, and what stands for it: a small data set, a shipped network, or a command's result."""
READ = ("--data", "--run", "--init", "--push-net", "--grasp-net", "--value-net", "--clear", "--prediction", "--grasp")
"""Options that name what a command reads."""
READERS = ("info", "verify", "repair", "replay", "export", "merge")
"""Commands that read the folders that they name without an option."""


def commands(page: pathlib.Path) -> list[list[str]]:
    """Return the words of every shell command on a page, without `.venv/bin/` and comments."""
    lines = "\n".join(block[1] for block in SHELL.finditer(page.read_text())).replace("\\\n", " ").splitlines()
    return [[word.removeprefix(BIN) for word in shlex.split(line, comments=True)] for line in lines if line.strip()]


def smaller(words: list[str]) -> list[str]:
    """Return a command of ours made small; folders outside of the current one become folders in it."""
    if "--" in words:  # dipn-train sweep: what is swept comes after it
        at = words.index("--") + 1
        return [*smaller(words[: at - 1]), "--", *smaller([words[0], *words[at:]])[1:]]
    by_option = _by_option([_near(word) for word in words[2:]])
    by_option |= {name: list(VALUES[name]) for name in by_option if name in VALUES}
    clearing = words[0] == "dipn-eval" and words[1] in ("clear", "sweep")
    if clearing and "--of" in by_option:
        by_option["--instances"] = ["2"]  # a table for each worker
    if any(":" in each for each in by_option.get("--distances", ())):
        by_option["--distances"] = ["0.05:0.1:0.05"]
    extra = ALWAYS.get((words[0], words[1]), ())
    for name, value in zip(extra[::2], extra[1::2], strict=True):
        by_option.setdefault(name, [value])
    if "--curve" in by_option:
        by_option["--curve"] = [each for pattern in by_option["--curve"] for each in sorted(glob.glob(pattern))]
    cases = " ".join(by_option.get("--cases", ["hard"]))
    if clearing and cases in ONE_CASE:
        by_option.setdefault("--names", [ONE_CASE[cases]])
    return [*words[:2], *(word for name, values in by_option.items() for word in (name, *values) if word)]


def _near(word: str) -> str:
    """Return a word whose folder, if it names one elsewhere, is one in the current folder."""
    if "://" in word:
        return f"file://{pathlib.Path(word.partition('://')[2]).resolve()}"
    return word.lstrip("/") if word.startswith("/") else word


def _by_option(words: list[str]) -> dict[str, list[str]]:
    """Return words by the option before them; those before the first are of the option ``."""
    found: dict[str, list[str]] = {"": []}
    name = ""
    for word in words:
        if word.startswith("--"):
            name = word
            found[name] = []
        else:
            found[name].append(word)
    return found


def is_read(words: list[str]) -> list[str]:
    """Return the places that a command reads, and which a page may expect to be there."""
    by_option = _by_option(words[2:])
    named = [place for name in READ for place in by_option.get(name, ())]
    named += by_option[""] if words[1] in READERS else []
    return [place for place in named if "/" in place]


def stand_in(place: str, data: dict[str, pathlib.Path]) -> list[str] | None:
    """Put what a page expects to be there in its place, if it is not there.

    Args:
      place: what a command reads.
      data: a small data set of each kind.

    Returns:
      The command that makes it, where there is nothing to copy.
    """
    folder = pathlib.Path(place.partition("://")[2] or re.sub("@.*", "", place))
    if folder.exists():
        return None
    name = str(folder.relative_to(pathlib.Path.cwd()) if folder.is_absolute() else folder)
    assert name in STAND_INS, f"{name}: neither made by the page nor expected by it to be there"
    stands = STAND_INS[name]
    if isinstance(stands, tuple):
        return [*stands, "--out", str(folder)]
    sources = {**data, "dipn": SHIPPED / "dipn", "gn": SHIPPED / "grasp"}
    shutil.copytree(sources[stands], folder)
    return None


def ours(words: list[str]) -> bool:
    """Check whether a command is one of ours."""
    return words[0] in runs.PROGRAMS


def block(page: pathlib.Path, language: str) -> str:
    """Return the first block of a page in a language."""
    found = re.search(rf"^```{language}\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
    assert found, page
    return found[1]
