"""A page that is served from this machine, and what happens meanwhile, told to whoever looks at it."""

from __future__ import annotations

import errno
import json
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from torchrl_sspl.errors import ConfigError


class Feed:
    """What happened last, at most so many events, for any number of readers, each at its own pace. Source: none.

    Example:
        >>> feed = Feed()
        >>> feed.publish({"step": 1}, "data:,")
        >>> feed.close()
        >>> list(feed.events())
        [{'step': 1, 'picture': 'data:,'}]
    """

    def __init__(self, kept: int = 300) -> None:
        self._changed, self._open = threading.Condition(), True
        self._recent: deque[dict[str, Any]] = deque(maxlen=kept)
        self._count, self._picture = 0, ""

    def publish(self, event: dict[str, Any], picture: str = "") -> None:
        """One more event, and the picture that belongs to it, if there is one."""
        with self._changed:
            self._recent.append(event)
            self._picture = picture
            self._count += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Readers come to an end."""
        with self._changed:
            self._open = False
            self._changed.notify_all()

    def events(self) -> Iterator[dict[str, Any]]:
        """Events still kept, then those that come, the newest with its picture; who is too slow misses some."""
        read = 0
        while True:
            with self._changed:
                while self._count == read and self._open:
                    self._changed.wait()
                new = list(self._recent)[-(self._count - read) :] if self._count > read else []
                read, ended, picture = self._count, not self._open, self._picture
            yield from new[:-1]
            yield from [event | {"picture": picture} if picture else event for event in new[-1:]]
            if ended:
                return


@contextmanager
def served(host: str, port: int, feed: Feed, page: Callable[[], str]) -> Iterator[str]:
    """Serves a page, made when it is asked for, and what a feed tells, in threads of its own; the address.

    At the end readers come to an end too. Raises ConfigError for a port that is taken. Source: none.

    Example:
        >>> from urllib.request import urlopen
        >>> with served("127.0.0.1", 0, Feed(), lambda: "a page") as address:
        ...     urlopen(address).read()
        b'a page'
    """

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path == "/":
                self._answer(200, "text/html; charset=utf-8", page().encode())
            elif self.path == "/events":
                self._stream()
            else:
                self._answer(404, "text/plain; charset=utf-8", b"not here\n")

        def _answer(self, status: int, kind: str, body: bytes) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Security-Policy", "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
                             "img-src data:; connect-src 'self'")  # fmt: skip
            self.end_headers()
            self.wfile.write(body)

        def _stream(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/event-stream")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            try:
                for event in feed.events():
                    self.wfile.write(f"data: {json.dumps(event)}\n\n".encode())
                self.wfile.write(b"event: end\ndata: {}\n\n")
            except OSError:
                pass  # whoever looked has gone

        def log_message(self, *arguments: Any) -> None:
            """Nothing: the terminal is not for that."""

    try:
        server = ThreadingHTTPServer((host, port), Handler)
    except OSError as error:
        why = "which is taken" if error.errno == errno.EADDRINUSE else f"which cannot be used ({error})"
        raise ConfigError(f"expected a free port, received {host}:{port}, {why}; choose another with --port, 0 takes any") from error
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True).start()
    try:
        yield f"http://{host}:{server.server_address[1]}/"
    finally:
        feed.close()
        server.shutdown()
        server.server_close()


__all__ = ["Feed", "served"]
