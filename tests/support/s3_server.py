"""An S3 server on this machine, moto's, which a test can break in the middle of an upload.

It checks no signatures, keeps everything in memory, and is consistent at once; it has no throttling and no slow parts.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from qsim.publishing import place

SECRETS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}
SECRETS |= {"AWS_MAX_ATTEMPTS": "1"}  # s3fs tries again, too


@dataclass
class Server:
    """A server with one bucket, `bucket`."""

    app: Any
    uploads_left: int | None = None  # before every upload is cut; None: none is
    bytes_read: int = 0  # that were sent to readers

    def __call__(self, environ: dict[str, Any], answer: Any) -> Any:
        if environ["REQUEST_METHOD"] in ("PUT", "POST") and self.uploads_left is not None:
            if self.uploads_left == 0:
                environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0) // 2)
                environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)  # in the middle of the body
                answer("500 Cut", [])
                return [b""]
            self.uploads_left -= 1
        found = list(self.app(environ, answer))
        if environ["REQUEST_METHOD"] == "GET":
            self.bytes_read += sum(map(len, found))
        return found


@contextlib.contextmanager
def serving(patch: pytest.MonkeyPatch) -> Iterator[Server]:
    """Run the server in a thread; inside, addresses s3://bucket/... lead to it."""
    import boto3
    import s3fs
    from moto.server import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log(self, *_: Any) -> None:
            """Print nothing."""

    server = Server(DomainDispatcherApplication(create_backend_app))
    http = make_server("127.0.0.1", 0, server, threaded=True, request_handler=Quiet)
    thread = threading.Thread(target=http.serve_forever, daemon=True)
    thread.start()
    address = f"http://127.0.0.1:{http.server_port}"
    for name, value in (SECRETS | {"AWS_ENDPOINT_URL": address}).items():
        patch.setenv(name, value)
    place._system.cache_clear()  # of the server before
    s3fs.S3FileSystem.clear_instance_cache()
    urllib.request.urlopen(f"{address}/moto-api/reset", data=b"").close()
    boto3.client("s3", endpoint_url=address).create_bucket(Bucket="bucket")
    try:
        yield server
    finally:
        http.shutdown()
        thread.join()
        http.server_close()
