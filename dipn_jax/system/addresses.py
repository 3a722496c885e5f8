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


def accepts_urls(hint: Any) -> bool:
    """Return whether an option of this type accepts URLs: it is a `Place`, or several."""
    return OR_URL in getattr(hint, "__metadata__", ()) or any(map(accepts_urls, typing.get_args(hint)))


def show_instead(folder: pathlib.Path, url: str) -> None:
    """From now on show this URL instead of its local copy, the folder, in messages."""
    _names[str(folder)] = url


def with_urls(text: str) -> str:
    """Return `text` with URLs in place of the folders that `show_instead` was given."""
    for folder, name in _names.items():
        text = text.replace(folder, name)
    return text
