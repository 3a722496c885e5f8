"""Object storage (S3, Google, Azure, or a folder by its URL), through obstore: whole objects, no locks, no renames."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import importlib.util
import pathlib
import re
import urllib.parse
from collections.abc import Iterator
from typing import Any

from dipn_jax.errors import UserError
from dipn_jax.system import typed

CREDENTIAL_VARIABLES = {
    "s3": "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_REGION; elsewhere than at Amazon AWS_ENDPOINT, too",
    "gs": "GOOGLE_APPLICATION_CREDENTIALS",
    "az": "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
}
"""What the environment has to say, by scheme."""
NO_CREDENTIALS = ("/latest/api/token", "/latest/meta-data", "computeMetadata", "metadata/identity", "Account must be")
"""Parts of the messages that come where the environment says nothing: a provider's own machine is then asked."""
FIRST_RETRIES = {"max_retries": 1, "retry_timeout": datetime.timedelta(seconds=20)}
"""How often the first request is tried again: a mistake of the user's is said soon; later ones have obstore's patience.
"""
NO_BUCKET = ("NoSuchBucket", "ContainerNotFound")
"""Parts of the answers where there is no bucket."""
MAX_MESSAGE_CHARS = 200
"""Characters of a reason that are shown at most."""


@dataclasses.dataclass(frozen=True)
class Found:
    """An object as it is listed."""

    size: int  # bytes
    tag: str  # another one for other content


class Bucket:
    """What is below a URL. Threads may share it, forked processes may not."""

    def __init__(self, url: str, *, make: bool = False, look: bool = True) -> None:
        """Open what is below a URL, and check that it can be listed.

        Args:
          url: from `addresses.url`.
          make: whether the folder of a file:// URL is made where there is none.
          look: whether to look at all; without, the first use says that it cannot be used.

        Raises:
          UserError: it cannot be listed; obstore is not installed.
        """
        if importlib.util.find_spec("obstore") is None:
            raise UserError(f"{url}: obstore is not installed; pip install 'dipn-jax[cloud]'")
        self.url, self.scheme = url, url.partition(":")[0]
        if not url.partition("://")[2].strip("/"):
            raise UserError(f"{url}: names no bucket; give one, as in {self.scheme}://BUCKET/FOLDER")
        with self._said():
            if look:
                next(self._listed(_opened(url, make=make, retry_config=FIRST_RETRIES)), None)
            self._store = _opened(url, make=make)

    def list(self) -> dict[str, Found]:
        """Return the objects by their name; not those that have a slash in it."""
        with self._said():
            pages = list(self._listed(self._store))
        found = {one["path"]: Found(one["size"], str(one["e_tag"])) for page in pages for one in page}
        return {name: found[name] for name in sorted(found) if "/" not in name}

    def head(self, name: str) -> Found | None:
        """Return what a list would say of an object, by one request; None where there is none."""
        import obstore

        with self._said(), contextlib.suppress(FileNotFoundError):
            got = obstore.head(self._store, name)
            return Found(got["size"], str(got["e_tag"]))
        return None

    def get(self, name: str) -> tuple[bytes, Found] | None:
        """Return the content of an object; None where there is none."""
        import obstore

        with self._said(), contextlib.suppress(FileNotFoundError):
            got = obstore.get(self._store, name)
            data = bytes(got.bytes())
            return data, Found(len(data), str(got.meta["e_tag"]))
        return None

    def create(self, name: str, data: bytes) -> bool:
        """Write an object unless there is one of that name; return whether it was written, so that one writer wins."""
        import obstore

        with self._said():
            try:
                obstore.put(self._store, name, data, mode="create")
            except obstore.exceptions.AlreadyExistsError:
                return False
        return True

    def put(self, name: str, data: bytes) -> None:
        """Write an object; one of that name is replaced."""
        import obstore

        with self._said():
            obstore.put(self._store, name, data, mode="overwrite")

    def delete(self, name: str) -> None:
        """Delete an object, if it is there."""
        import obstore

        with self._said(), contextlib.suppress(FileNotFoundError):
            obstore.delete(self._store, name)

    @staticmethod
    def _listed(store: Any) -> Iterator[Any]:
        import obstore

        return iter(obstore.list(store))

    @contextlib.contextmanager
    def _said(self) -> Iterator[None]:
        """Turn any error of the storage into a UserError of one line."""
        import obstore

        try:
            yield
        except (obstore.exceptions.BaseError, OSError) as error:
            raise UserError(f"{self.url}: {self._why(error)}") from None

    def _why(self, error: Exception) -> str:
        """Return what is wrong with the storage, and what to do."""
        text = str(error)
        answer = re.search("<Message>([^<]+)", text)
        first = answer[1] if answer else text.strip().split("\n")[0]
        if self.scheme == "file":
            return f"cannot be used ({typed.one_line(first, most=MAX_MESSAGE_CHARS)}); give another folder"
        if isinstance(error, FileNotFoundError) or any(part in text for part in NO_BUCKET):
            return "no such bucket; make it, or give another"
        needs = f"the environment has to say {CREDENTIAL_VARIABLES[self.scheme]}"
        if any(part in text for part in NO_CREDENTIALS):
            return f"no credentials; {needs}"
        return f"cannot be used ({typed.one_line(first, most=MAX_MESSAGE_CHARS)}); {needs}"


def _opened(url: str, *, make: bool, **options: Any) -> Any:
    """Return obstore's store at a URL."""
    import obstore.store

    if url.startswith("file://"):
        folder = pathlib.Path(urllib.parse.unquote(url.removeprefix("file://")))
        if not make and not folder.is_dir():
            raise UserError(f"data set {url}: no such folder; give one that dipn-datagen wrote")
        return obstore.store.LocalStore(folder, mkdir=make)
    return obstore.store.from_url(url, **options)
