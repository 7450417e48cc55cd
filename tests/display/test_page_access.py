"""The live page: who may do what, and what STOP accepts."""

from __future__ import annotations

import json
from urllib.parse import parse_qs, urlsplit

import pytest

from perchctl.display import LivePage
from perchctl.display.live import TOKEN_HEADER, is_loopback
from tests.helpers.live_page import Stops, ask, stop
from tests.helpers.recording import camera


def token_of(url: str) -> str:
    return parse_qs(urlsplit(url).query)["token"][0]


def test_stop_needs_the_token(page: LivePage, stops: Stops) -> None:
    assert stop(page.url, "") == 403
    assert stop(page.url, "wrong") == 403
    assert stop(page.url, "w\xf6rng") == 403
    assert ask(page.url, f"/stop?token={page.token}", "POST")[0] == 403  # a form can send that
    assert ask(page.url, "/stop", "GET", **{TOKEN_HEADER: page.token})[0] == 404
    assert stops.count == 0
    assert stop(page.url, token_of(page.url)) == 200
    assert stops.count == 1
    assert json.loads(ask(page.url, "/state")[1])["stop"] == "requested"


def test_stop_again_changes_nothing(page: LivePage, stops: Stops) -> None:
    assert [stop(page.url, page.token) for _ in range(3)] == [200, 200, 200]
    assert stops.count == 1


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", ""])
@pytest.mark.parametrize("path", ["/", "/state", "/stream"])
def test_a_foreign_host_is_refused(page: LivePage, host: str, path: str) -> None:
    status, body, _ = ask(page.url, path, Host=host)
    assert status == 403
    assert page.token.encode() not in body


def test_stop_refuses_a_foreign_host_and_origin(page: LivePage, stops: Stops) -> None:
    assert stop(page.url, page.token, Host="evil.example") == 403
    assert stop(page.url, page.token, Origin="http://evil.example") == 403
    assert stop(page.url, page.token, Origin="null") == 403
    assert stops.count == 0
    assert stop(page.url, page.token, Origin="http://localhost:9", Host="localhost:9") == 200


@pytest.mark.parametrize(
    ("host", "local"),
    [
        ("127.0.0.1:80", True),
        ("localhost", True),
        ("LOCALHOST:8080", True),
        ("[::1]:80", True),
        ("user@127.0.0.1", True),
        ("127.0.0.1@evil.example", False),
        ("127.0.0.2", False),
        ("[", False),
        (None, False),
    ],
)
def test_the_names_of_this_machine(host: str | None, local: bool) -> None:
    assert is_loopback(host) is local


def test_it_listens_on_loopback_only(page: LivePage) -> None:
    assert page._server.server_address[0] == "127.0.0.1"


def test_without_stop_there_is_none() -> None:
    page = LivePage(camera(), "t")
    try:
        assert json.loads(ask(page.url, "/state")[1])["stop"] == "none"
        assert stop(page.url, page.token) == 403
    finally:
        page.close()
