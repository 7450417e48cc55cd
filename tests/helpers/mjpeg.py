"""A Motion-JPEG server on loopback whose every byte the test chooses."""

from __future__ import annotations

import contextlib
import queue
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from tests.helpers.live import WAIT_S
from tests.helpers.waiting import until

Script = list[bytes | threading.Event]


class MjpegServer:
    """Serves one script a connection: bytes to send, events to wait for, then the end.

    Who does not answer one of its `challenges` by name or by the right nonce is refused.
    """

    def __init__(self) -> None:
        self.scripts: queue.Queue[Script] = queue.Queue()
        self.status, self.redirect = 200, ""
        self.nonce = "n1"
        self.authorization: list[str | None] = []
        self.challenges: list[str] = []
        self.closing = threading.Event()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                given = self.headers["Authorization"]
                outer.authorization.append(given)
                known = given and (given.startswith("Basic") or f'nonce="{outer.nonce}"' in given)
                if outer.challenges and not known:
                    self.send_response(401)
                    for challenge in outer.challenges:
                        self.send_header("WWW-Authenticate", challenge)
                    self.send_header("Content-Length", "0")
                    self.end_headers()
                    return
                self.send_response(302 if outer.redirect else outer.status)
                if outer.redirect:
                    self.send_header("Location", outer.redirect)
                    self.send_header("Content-Length", "0")
                self.end_headers()
                script = [] if outer.scripts.empty() else outer.scripts.get()
                with contextlib.suppress(OSError):
                    for step in script:
                        if isinstance(step, threading.Event):
                            until(lambda step=step: step.is_set() or outer.closing.is_set())
                        else:
                            self.wfile.write(step)

            def log_message(self, format: str, *args: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/stream.mjpg"
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        self.closing.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(WAIT_S)
