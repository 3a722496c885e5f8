"""URLs of object storage in place of folders, and the names by which messages call folders.

A command's option of the type `Place` takes a URL; `files.with_absolute_paths` refuses them elsewhere.
"""

from __future__ import annotations

import pathlib
import re
import typing
from typing import Annotated, Any

OR_URL = "or a URL"
"""Mark of the options that take a URL, too."""
Place = Annotated[pathlib.Path, OR_URL]
"""The folder of a data set, or its URL, which as a path has one slash behind the colon: `url` returns it."""
_URL = re.compile(r"(s3|gs|az|file):(?:/+(.*))?", re.DOTALL)
_names: dict[str, str] = {}


def url(place: pathlib.Path | str) -> str | None:
    """Return the URL of a place in object storage, such as s3://bucket/data, that a user gave; None for a path."""
    found = _URL.fullmatch(str(place))
    return found and f"{found[1]}://{'/' if found[1] == 'file' else ''}{(found[2] or '').rstrip('/')}"


def taken(hint: Any) -> bool:
    """Return whether an option of this type takes a URL, too: it is a `Place`, or several."""
    return OR_URL in getattr(hint, "__metadata__", ()) or any(map(taken, typing.get_args(hint)))


def call(folder: pathlib.Path, name: str) -> None:
    """Show `name` instead of `folder` in messages: the folder is a copy of what has this name."""
    _names[str(folder)] = name


def named(text: str) -> str:
    """Return `text` with the names that `call` gave instead of their folders."""
    for folder, name in _names.items():
        text = text.replace(folder, name)
    return text
