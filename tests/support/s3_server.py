"""An S3 server in this process, with one bucket that keeps every version of an object."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

KILLED = """
import os, signal, sys, threading
from dipn_jax.datagen import cli
from dipn_jax.commands import console
from dipn_jax.storage.objects import Bucket
create, made, turn = Bucket.create, [], threading.Lock()
def creating(self, name, data):
    with turn:
        if name.startswith("shard") and len(made) == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        made.extend([name] * name.startswith("shard"))
        return create(self, name, data)
Bucket.create = creating
sys.exit(console.run("test", cli.COMMANDS, sys.argv[1:]))
"""
"""`dipn-datagen`, killed before it would create its third shard."""


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


def kill_at_third_shard(words: Sequence[str]) -> None:
    """Run `dipn-datagen` with `words` and kill it by SIGKILL before it creates its third shard in a bucket."""
    killed = subprocess.run([sys.executable, "-c", KILLED, *words], capture_output=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
