"""One module's mutants: made by Cosmic Ray and held against the module's tests, in a scratch copy of this checkout."""

from __future__ import annotations

import ast
import os
import pathlib
import shlex
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

from dipn_jax.errors import UserError
from dipn_jax.system import files, machine

ROOT = pathlib.Path(__file__).parent.parent
"""The folder of this checkout."""
STAGES = ("datagen", "train", "eval")
"""Folders that are imported as packages inside the library."""
PATIENCE = 10.0
"""A mutant is killed, too, when its tests take this many times as long as without mutation."""
SHORTEST_PATIENCE = 60.0
"""Seconds that every mutant has at least."""

GUARDS = ("strict", "frozen")
"""Arguments, of `zip` and of `dataclass`, that refuse what a correct program does not do, and change no result."""
_BINARY = (
    "Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_Mul", "Pow_Mul", "BitAnd_BitOr", "BitOr_BitAnd",
    "BitXor_BitOr", "LShift_RShift", "RShift_LShift",
)  # fmt: skip
_COMPARISONS = (
    "Lt_LtE", "Lt_GtE", "LtE_Lt", "LtE_Gt", "Gt_GtE", "Gt_LtE", "GtE_Gt", "GtE_Lt", "Eq_NotEq", "NotEq_Eq", "Is_IsNot",
    "IsNot_Is", "In_NotIn", "NotIn_In",
)  # fmt: skip
OPERATORS = frozenset(
    f"core/{name}"
    for name in (
        *(f"ReplaceBinaryOperator_{pair}" for pair in _BINARY),
        *(f"ReplaceComparisonOperator_{pair}" for pair in _COMPARISONS),
        *(f"ReplaceUnaryOperator_Delete_{name}" for name in ("Invert", "Not", "USub")),
        *("AddNot", "NumberReplacer", "ReplaceAndWithOr", "ReplaceOrWithAnd", "ReplaceTrueWithFalse"),
        *("ReplaceFalseWithTrue", "ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "ZeroIterationForLoop"),
    )
)
"""Cosmic Ray's operators that are applied: of its eleven replacements of an arithmetic operator the opposite one, of
its seven of a comparison the negation and the one that differs at the boundary, and of the others those that fit."""


def run(module: str, tests: Sequence[str], out: pathlib.Path) -> dict[str, Any]:
    """Hold the mutants of a module that are left against its tests, and return the `result` of all.

    Args:
      module: path of the module in this checkout.
      tests: paths of its tests.
      out: folder of the sessions.

    Raises:
      UserError: the tests fail without mutation, or pass with a module that cannot be imported.
    """
    session = out / f"{module.removesuffix('.py').replace('/', '.')}.sqlite"
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = pathlib.Path(folder) / "copy"
        _copy(copy)
        patience = max(SHORTEST_PATIENCE, PATIENCE * _check(copy, module, tests))
        config = pathlib.Path(folder) / "cosmic-ray.toml"
        files.write_text(config, _config(module, tests, patience))
        _prepare(copy, config, session, module, tests)
        _python(copy, "experiments.mutants_exec", str(config), str(session))
    return result(session)


def test_command(tests: Sequence[str]) -> str:
    """Return the command that fails if a mutant is found out."""
    return shlex.join([sys.executable, "-m", "pytest", "-x", "-p", "no:xdist", *tests])


def _config(module: str, tests: Sequence[str], patience: float) -> str:
    lines = [
        "[cosmic-ray]",
        f'module-path = "{module}"',
        f"timeout = {patience:.1f}",
        "excluded-modules = []",
        f"test-command = '''{test_command(tests)}'''",
        "[cosmic-ray.distributor]",
        'name = "local"',
    ]
    return "\n".join(lines) + "\n"


def _copy(copy: pathlib.Path) -> None:
    """Copy the checkout's files as they are now; the stages are links inside the library, as they are imported."""
    listed = ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, check=True, capture_output=True).stdout.decode().split("\0")
    for name in names:
        if name and (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, copy / name)
    for stage in STAGES:
        (copy / "dipn_jax" / stage).symlink_to(copy / stage)


def _environment(copy: pathlib.Path) -> dict[str, str]:
    """Return the environment in which Python imports the copy, and not what is installed."""
    return {**os.environ, "PYTHONPATH": str(copy)}


def _check(copy: pathlib.Path, module: str, tests: Sequence[str]) -> float:
    """Return how many seconds the tests take; raise a UserError where they say nothing about the module."""

    def passes() -> bool:
        return subprocess.run(shlex.split(test_command(tests)), cwd=copy, env=_environment(copy)).returncode == 0

    begun = time.monotonic()
    if not passes():
        raise UserError(f"the tests of {module} fail without mutation; correct them first: {' '.join(tests)}")
    seconds = time.monotonic() - begun
    text = files.read_text(copy / module)
    files.write_text(copy / module, 'raise RuntimeError("not to be imported")\n')
    if passes():
        raise UserError(f"the tests of {module} pass though it cannot be imported; want tests of it: {' '.join(tests)}")
    files.write_text(copy / module, text)
    return seconds


def _python(copy: pathlib.Path, module: str, *arguments: str) -> None:
    """Run a module in the copy."""
    subprocess.run([sys.executable, "-m", module, *arguments], cwd=copy, env=_environment(copy), check=True)


def _prepare(
    copy: pathlib.Path, config: pathlib.Path, session: pathlib.Path, module: str, tests: Sequence[str]
) -> None:
    """Begin a session or continue one: all mutants again if the module has changed, survivors if its tests have."""
    from cosmic_ray.work_db import use_db

    stamp = session.with_suffix(".json")
    now = {
        "module": files.file_sha256(copy / module),
        "operators": sorted(OPERATORS),
        "tests": {name: files.file_sha256(copy / name) for name in tests},
    }
    before = files.read_json(stamp) if stamp.exists() and session.exists() else {}
    if any(before.get(key) != now[key] for key in ("module", "operators")):
        stamp.unlink(missing_ok=True)
        session.unlink(missing_ok=True)  # Cosmic Ray does not begin a session that has results
        _python(copy, "cosmic_ray.cli", "init", str(config), str(session))
        with use_db(str(session)) as database:
            _skip(database, files.read_text(copy / module))
    elif before["tests"] != now["tests"]:
        _forget_survivors(session)
        with use_db(str(session)) as database:
            _skip(database, files.read_text(copy / module))
    files.write_json(stamp, now)


def _skip(database: Any, source: str) -> None:
    """Mark as skipped what is not to be run: other operators, `left_alone`, and a star that multiplies nothing."""
    from cosmic_ray.work_item import WorkerOutcome, WorkResult

    spans, lines = left_alone(source), source.splitlines()
    for item in database.pending_work_items:
        (mutation,) = item.mutations
        row, column = mutation.start_pos
        inside = any(begin <= (row, column) < end for begin, end in spans)
        star = "_Mul_" in mutation.operator_name and lines[row - 1][column + 1 : column + 2] != " "
        if inside or star or mutation.operator_name not in OPERATORS:
            database.set_result(item.job_id, WorkResult(worker_outcome=WorkerOutcome.SKIPPED))


def left_alone(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return where annotations, and the values of the arguments `GUARDS`, begin and end in a module.

    Returns:
      Begin and end of each: line, from 1, and column, from 0.
    """
    found: list[ast.expr | None] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.arg | ast.AnnAssign):
            found.append(node.annotation)
        elif isinstance(node, ast.keyword) and node.arg in GUARDS:
            found.append(node.value)
        elif isinstance(node, ast.FunctionDef):
            found.append(node.returns)
    return [((n.lineno, n.col_offset), (n.end_lineno or 0, n.end_col_offset or 0)) for n in found if n]


def _forget_survivors(session: pathlib.Path) -> None:
    """Let the survivors of a session be run again; Cosmic Ray has no call for it."""
    with sqlite3.connect(session) as database:
        database.execute("DELETE FROM work_results WHERE test_outcome = 'SURVIVED'")


def result(session: pathlib.Path) -> dict[str, Any]:
    """Return what became of the mutants of a session.

    Returns:
      `mutants` and `killed`, their numbers; `survivors`, each with its `line`, `operator`, and the line before and
      after, `was` and `became`; and `commit`, of these sources.
    """
    from cosmic_ray.work_db import use_db

    with use_db(str(session)) as database:
        run_ones = [(item.mutations[0], each) for item, each in database.completed_work_items if each.test_outcome]
    survivors = []
    for mutation, each in run_ones:
        if not each.is_killed:
            was, became = changed(each.diff)
            operator = mutation.operator_name.removeprefix("core/")
            survivors.append({"line": mutation.start_pos[0], "operator": operator, "was": was, "became": became})
    survivors.sort(key=lambda each: (each["line"], each["operator"], each["became"]))
    killed = len(run_ones) - len(survivors)
    return {"mutants": len(run_ones), "killed": killed, "survivors": survivors, "commit": machine.commit()}


def changed(diff: str) -> tuple[str, str]:
    """Return the line of a unified diff that is taken away, and the one that is added, without indentation."""
    lines = [line for line in diff.splitlines() if not line.startswith(("---", "+++"))]
    was, became = (next((line[1:].strip() for line in lines if line.startswith(sign)), "") for sign in "-+")
    return was, became
