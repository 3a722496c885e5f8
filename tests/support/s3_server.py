"""An S3 server in this process, with one bucket that keeps every version of an object."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import pytest


@contextlib.contextmanager
def running(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Start the server, and let the environment name it; skip the test where moto is not installed."""
    for name in ("moto", "flask", "flask_cors"):
        pytest.importorskip(name)
    import logging

    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in {
        "AWS_ENDPOINT": f"http://{host}:{port}",
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(name, value)
    try:
        client().create_bucket(Bucket="bucket")
        client().put_bucket_versioning(Bucket="bucket", VersioningConfiguration={"Status": "Enabled"})
        yield
    finally:
        server.stop()
        from moto.s3.models import s3_backends

        s3_backends.reset()


def client() -> Any:
    """Return a client of the server that is not obstore."""
    import boto3

    return boto3.client("s3", endpoint_url=os.environ["AWS_ENDPOINT"], region_name="us-east-1")


def versions(folder: str) -> dict[str, int]:
    """Return how often each object of a folder of the bucket has been written."""
    found = client().list_object_versions(Bucket="bucket", Prefix=f"{folder}/").get("Versions", [])
    keys = [one["Key"].rpartition("/")[2] for one in found]
    return {key: keys.count(key) for key in keys}


def contents(folder: str) -> dict[str, bytes]:
    """Return the objects of a folder of the bucket."""
    keys = [one["Key"] for one in client().list_objects_v2(Bucket="bucket", Prefix=f"{folder}/").get("Contents", [])]
    return {key.rpartition("/")[2]: client().get_object(Bucket="bucket", Key=key)["Body"].read() for key in keys}
