"""The process beside `on_gpu` in which the stages run."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

COMMAND = (sys.executable, "-m", "benchmarks.gpu_stage")
"""What is started."""


class Worker:
    """The process that measures; see `gpu_stage`. Its children are in its group and end with it."""

    def __init__(self) -> None:
        """Start the process."""
        # the device's memory is shared with processes of other frameworks
        environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"} | os.environ
        self.process = subprocess.Popen(
            COMMAND,
            cwd=pathlib.Path(__file__).parent.parent,
            env=environment,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        self.machine: dict[str, Any] = {}
        self._answers: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._answers.put(line)
        self._answers.put("")

    def ask(self, request: dict[str, Any]) -> None:
        """Send a stage to the process; if the process has ended, `answers` says so."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()

    def answers(self, until: float) -> Iterator[dict[str, Any]]:
        """Yield the answers of the process, up to the end of a stage.

        Args:
          until: instant of the monotonic clock.

        Raises:
          TimeoutError: the stage has not ended by then.
          EOFError: the process has.
        """
        while True:
            try:
                line = self._answers.get(timeout=max(0.0, until - time.monotonic()))
            except queue.Empty:
                raise TimeoutError from None
            if not line:
                raise EOFError(f"its process ended with code {self.process.wait()}")
            answer = json.loads(line)
            yield answer
            if "ended" in answer:
                return

    def end(self) -> None:
        """End the process and its children."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
