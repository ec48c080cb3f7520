"""A server of one weights file, whose connection, ranges and errors tests decide; and catalogues of it."""

import contextlib
import hashlib
import http.server
import threading
from collections.abc import Iterator

import numpy as np

from ipjax.files.weights import catalogue, encoder, finding, local
from ipjax.files.weights.catalogue import Source


class Server(http.server.ThreadingHTTPServer):
    """Serves one file; can close the connection early, ignore ranges, or answer with an error."""

    def __init__(self, data: bytes):
        super().__init__(("127.0.0.1", 0), Handler)
        self.data, self.stop_after, self.ranges, self.error = data, [], True, 0
        self.requests: list[str] = []
        self.hold: threading.Event | None = None  # where given, the second half waits for it

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/weights.pth"


class Handler(http.server.BaseHTTPRequestHandler):
    server: Server

    def do_GET(self):
        server, wanted = self.server, self.headers.get("Range", "")
        server.requests.append(wanted)
        if server.error:
            return self.send_error(server.error)
        start = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted and server.ranges else 0
        if wanted and server.ranges and start >= len(server.data):
            return self.send_error(416)
        rest = server.data[start:]
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(rest)))
        self.end_headers()
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            rest = rest[: server.stop_after.pop(0)] if server.stop_after else rest
            step = len(rest) if server.hold is None else 2**17
            for begin in range(0, len(rest), max(step, 1)):
                if server.hold is not None and begin > len(rest) // 2:
                    server.hold.wait(timeout=100)
                self.wfile.write(rest[begin : begin + step])

    def log_message(self, *_):
        pass


@contextlib.contextmanager
def serving() -> Iterator[Server]:
    """A server of three megabytes, on a thread of its own."""
    data = np.random.default_rng(0).bytes(3_000_000)
    with Server(data) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def source_of(server: Server, sha256: str | None = "right") -> Source:
    sha256 = hashlib.sha256(server.data).hexdigest() if sha256 == "right" else sha256
    return Source("test", "vits14", "weights.pth", "none", sha256, url=server.url)


def replace_catalogue(monkeypatch, entries: dict[str, Source]) -> dict[str, Source]:
    """For one test these are the known files."""
    for module in (catalogue, encoder, finding, local):
        monkeypatch.setattr(module, "CATALOGUE", entries)
    return entries
