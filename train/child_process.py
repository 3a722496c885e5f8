"""Run commands of `dipn-train` in a process that stops when its parent asks for it, or has ended."""

from __future__ import annotations

import os
import signal
import sys
import threading

from dipn_jax.commands import console
from dipn_jax.system import typed

from . import cli


def main() -> None:
    """Carry out the commands that the first argument lists as JSON, up to the first that fails, and exit as it does.

    The end of standard input, a pipe from the process that started this one, is taken as an interruption.
    """
    threading.Thread(target=_listen, daemon=True).start()
    for words in typed.check(typed.parse(sys.argv[1]), [[str]]):
        if code := console.run("Train networks.", cli.COMMANDS, words):
            sys.exit(code)


def _listen() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
