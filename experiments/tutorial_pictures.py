"""Make the pictures of docs/tutorial.md with the code that stands on that page.

python -m experiments.tutorial_pictures
"""

from __future__ import annotations

import argparse
import contextlib
import pathlib
import re
from typing import Any

DOCS = pathlib.Path(__file__).parent.parent / "docs"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
"""A fenced block of Python on a page."""


def run(page: pathlib.Path) -> dict[str, Any]:
    """Run the Python of a page from top to bottom in the current folder; return its variables."""
    names: dict[str, Any] = {"__name__": "__main__"}
    text = page.read_text(encoding="utf-8")
    for block in BLOCK.finditer(text):
        line = text.count("\n", 0, block.start(1))
        exec(compile("\n" * line + block[1], str(page), "exec"), names)
    return names


def main() -> None:
    """Make the pictures where the page looks for them."""
    argparse.ArgumentParser(prog="python -m experiments.tutorial_pictures", description=__doc__).parse_args()
    with contextlib.chdir(DOCS):
        run(DOCS / "tutorial.md")


if __name__ == "__main__":
    main()
