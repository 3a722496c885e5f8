"""Object storage by a file:// URL and, where moto is installed, S3: one writer wins, and mistakes are one line each."""

import concurrent.futures
import importlib.util
import pathlib
from collections.abc import Iterator

import pytest

from dipn_jax.errors import UserError
from dipn_jax.storage.objects import Bucket, Found


@pytest.fixture(params=["file", pytest.param("s3", marks=pytest.mark.slow)])
def bucket(request: pytest.FixtureRequest, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bucket]:
    if request.param == "file":
        yield Bucket(f"file://{tmp_path}/a%20b", make=True)
        return
    import s3_server

    with s3_server.running(monkeypatch):
        yield Bucket("s3://bucket/some/data")


def test_an_object_is_created_once_and_read_back(bucket: Bucket) -> None:
    assert bucket.list() == {} and bucket.get("x") is None and bucket.head("x") is None
    assert bucket.create("x", b"first") and not bucket.create("x", b"second")
    assert bucket.create("sub/y", b"")
    data, found = bucket.get("x") or (b"", Found(0, ""))
    assert data == b"first" and bucket.list() == {"x": found} and found.size == 5
    assert bucket.head("x") == found
    bucket.put("x", b"other")
    assert (bucket.get("x") or [b""])[0] == b"other" and bucket.list()["x"] != found
    bucket.delete("x")
    bucket.delete("x")
    assert bucket.list() == {}


def test_of_racing_writers_one_wins(bucket: Bucket) -> None:
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        for name in ("a", "b", "c"):
            won = list(pool.map(lambda number, name=name: bucket.create(name, bytes([number])), range(8)))
            assert sum(won) == 1 and (bucket.get(name) or [b""])[0] == bytes([won.index(True)])


def test_what_is_missing_is_said_in_one_line(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for url, said in (
        ("s3://", "s3://: names no bucket; give one, as in s3://BUCKET/FOLDER"),
        (
            f"file://{tmp_path}/gone",
            f"data set file://{tmp_path}/gone: no such folder; give one that dipn-datagen wrote",
        ),
    ):
        with pytest.raises(UserError) as error:
            Bucket(url)
        assert str(error.value) == said
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(UserError, match=r"^file://.*: cannot be used \(.*\); give another folder$"):
        Bucket(f"file://{tmp_path}/file/under", make=True)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"s3://b: obstore is not installed; pip install 'dipn-jax\[cloud\]'"):
        Bucket("s3://b")


@pytest.mark.parametrize("url", ["s3://bucket/x", "az://container/x"])
def test_an_environment_without_credentials_is_told_what_it_needs(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_ENDPOINT", "AZURE_STORAGE_ACCOUNT_NAME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_METADATA_ENDPOINT", "http://127.0.0.1:9")  # where nobody answers
    needs = {"s3": "AWS_ACCESS_KEY_ID, AWS_SECRET", "az": "AZURE_STORAGE_ACCOUNT_NAME"}[url[:2]]
    with pytest.raises(UserError, match=f"^{url}: no credentials; the environment has to say {needs}"):
        Bucket(url)


@pytest.mark.slow
def test_a_bucket_that_is_not_there_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    import s3_server

    with s3_server.running(monkeypatch):
        with pytest.raises(UserError, match=r"^s3://other/x: no such bucket; make it, or give another$"):
            Bucket("s3://other/x")
        bucket = Bucket("s3://bucket/x")
        s3_server.client().delete_bucket(Bucket="bucket")
        with pytest.raises(UserError, match=r"^s3://bucket/x: no such bucket"):
            bucket.put("x", b"")
