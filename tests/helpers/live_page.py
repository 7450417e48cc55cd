"""What the tests of the live page share: asking it, and its STOP."""

from __future__ import annotations

import http.client
from urllib.parse import urlsplit

import numpy as np

from perchctl.display.live import TOKEN_HEADER

CORNERS = np.array([[200.0, 150.0], [400.0, 150.0], [400.0, 350.0], [200.0, 350.0]])


def ask(
    url: str, path: str = "/", method: str = "GET", **headers: str
) -> tuple[int, bytes, dict[str, str]]:
    """Status, body and headers; `_` in a header's name stands for `-`."""
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(url).port or 0, timeout=5.0)
    try:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, headers=named)
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())
    finally:
        connection.close()


def stop(url: str, token: str, **headers: str) -> int:
    return ask(url, "/stop", "POST", **{TOKEN_HEADER: token}, **headers)[0]
