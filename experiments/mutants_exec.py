"""Cosmic Ray's `exec`, with a fork of this process for each mutant instead of a Python that imports everything anew.

    python -m experiments.mutants_exec CONFIG SESSION

The libraries are imported once; nothing of ours is, before the fork, so that every child imports the mutant.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import shlex
import sys

LIBRARIES = (
    "jax", "flax.nnx", "optax", "orbax.checkpoint", "grain", "mujoco.mjx", "pyarrow.parquet", "scipy.ndimage", "cv2",
    "tyro", "matplotlib.pyplot", "beartype", "jaxtyping", "pytest",
)  # fmt: skip
"""What is imported before the fork, of what tests import."""
PYTHON_M_PYTEST = 3
"""Number of words of a test command before the arguments of pytest."""


def _test(arguments: list[str]) -> None:
    """Run pytest, without a word, and end this process with its exit code."""
    import pytest

    sys.dont_write_bytecode = True
    sys.path.insert(0, os.getcwd())
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
        with contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
            code = int(pytest.main(arguments))
    os._exit(code)


def run_tests(command: str, timeout: float) -> tuple[str, str]:
    """Return whether a mutant survived its tests, as `cosmic_ray.testing.run_tests` does.

    Args:
      command: `PYTHON -m pytest ARGUMENTS`.
      timeout: seconds after which it counts as killed.
    """
    arguments = shlex.split(command)[PYTHON_M_PYTEST:]
    child = multiprocessing.get_context("fork").Process(target=_test, args=(arguments,))
    child.start()
    child.join(timeout)
    if child.is_alive():
        child.kill()
        child.join()
    return ("survived" if child.exitcode == 0 else "killed"), ""


def main() -> None:
    """Run Cosmic Ray's command."""
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
    for name in LIBRARIES:
        importlib.import_module(name)
    from cosmic_ray import cli, mutating

    mutating.run_tests = run_tests
    for name in [name for name in sys.modules if name.partition(".")[0] == "dipn_jax"]:
        del sys.modules[name]  # imported by this package; each child imports its own
    cli.main(["exec", *sys.argv[1:]])


if __name__ == "__main__":
    main()
