"""The live page of a fleet: its tiles, whose pictures it shows, and what its buttons accept."""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.display import FleetPage, FleetRow, LivePage, Sketch
from perchctl.mission import Phase
from tests.helpers.live_page import ask, press
from tests.helpers.recording import camera

STOPS = ("land", "cut", "land/1", "land/2")


@pytest.fixture
def fleet_page(ordered: list[str], clock: list[float]) -> Iterator[FleetPage]:
    served = FleetPage(
        "perchctl test",
        2,
        lambda: ordered.append("land"),
        lambda: ordered.append("cut"),
        lambda number: ordered.append(f"land/{number}"),
        clock=lambda: clock[0],
    )
    yield served
    served.close()


def state_of(page: FleetPage) -> dict[str, Any]:
    return dict(json.loads(ask(page.url, "/state")[1], parse_constant=pytest.fail))


def row(number: int, name: str, phase: str = "ALIGN", **more: Any) -> FleetRow:
    return FleetRow(number=number, name=name, phase=phase, reason="so it is", **more)


# --- what it shows ---------------------------------------------------------------------------


def test_each_vehicle_has_a_tile(fleet_page: FleetPage) -> None:
    known = {"height_m": 1.234, "error_m": 0.056, "battery_v": 3.7, "link_s": 0.012}
    fleet_page.show([row(1, "north", **known), row(2, "east", height_m=math.nan, is_silent=True)])
    north, east = state_of(fleet_page)["vehicles"]
    assert (north["name"], north["phase"], north["reason"]) == ("north", "ALIGN", "so it is")
    assert north["values"] == ["1.23 m", "5.6 cm", "3.70 V", "12 ms"]
    assert (north["bad"], east["bad"], east["silent"]) == (False, True, True)
    assert east["values"][1:] == ["", "", ""]


def test_a_page_that_is_opened_in_mid_flight_shows_what_has_been(fleet_page: FleetPage) -> None:
    for phase in ("SEARCH", "ALIGN", "RECOVER"):
        fleet_page.show([row(1, "north", phase)])
        fleet_page.event(f"north: {phase}")
    state = state_of(fleet_page)
    assert state["events"] == ["north: SEARCH", "north: ALIGN", "north: RECOVER"]
    assert state["vehicles"][0]["reached"] == state["steps"].index("ALIGN")
    fleet_page.show([row(1, "north", Phase.PERCHED.value, error_m=0.023)])
    assert state_of(fleet_page)["vehicles"][0]["values"][1] == ""
    fleet_page.show([row(1, "north", "hangs", hangs=True, has_ended=True, error_m=0.023)])
    assert state_of(fleet_page)["vehicles"][0]["values"][1] == ""
    state = state_of(fleet_page)
    assert state["vehicles"][0]["reached"] == len(state["steps"])
    assert (state["vehicles"][0]["bad"], state["orders"]) == (False, "over")


def test_the_numbers_tell_their_age_until_all_have_ended(
    fleet_page: FleetPage, clock: list[float]
) -> None:
    clock[0] += 60.0
    assert state_of(fleet_page)["age_s"] is None  # nothing is due before the first
    fleet_page.show([row(1, "north"), row(2, "east", "hangs", has_ended=True)])
    clock[0] += 3.0
    assert state_of(fleet_page)["age_s"] == 3.0
    fleet_page.show([row(1, "north", Phase.LANDED.value, has_ended=True)])
    assert state_of(fleet_page)["age_s"] is None


def test_the_page_needs_nothing_from_elsewhere(fleet_page: FleetPage) -> None:
    status, body, headers = ask(fleet_page.url)
    html = body.decode()
    assert status == 200
    for foreign in ("http://", "https://", "{{", fleet_page.token):
        assert foreign not in html
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert "STOP ALL" in html
    assert ask(fleet_page.url, "/stream")[0] == 404


# --- whose pictures --------------------------------------------------------------------------


def test_a_picture_comes_from_the_vehicles_own_process(
    fleet_page: FleetPage, clock: list[float]
) -> None:
    vehicle = LivePage(camera(), "north", clock=lambda: clock[0])
    try:
        fleet_page.show([row(1, "north", picture_port=vehicle.port), row(2, "east")])
        assert ask(fleet_page.url, "/picture/1")[0] == 404, "no picture yet"
        vehicle.show(Sketch(np.full((480, 640), 90, np.uint8)))
        status, body, headers = ask(fleet_page.url, "/picture/1?7")
        assert (status, headers["Content-Type"]) == (200, "image/jpeg")
        drawn = np.asarray(cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR))
        assert drawn.shape == (480, 640, 3)
        for other in ("/picture/2", "/picture/3", "/picture/", "/picture/1/1"):
            assert ask(fleet_page.url, other)[0] == 404
        clock[0] += 1.5
        assert ask(fleet_page.url, "/picture/1")[0] == 404, "its camera is silent"
    finally:
        vehicle.close()
    assert ask(fleet_page.url, "/picture/1")[0] == 404, "its process has ended"
    assert fleet_page.problem is None


def test_a_vehicle_that_hangs_holds_up_no_button(fleet_page: FleetPage, ordered: list[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        fleet_page.show([row(1, "north", picture_port=silent.getsockname()[1])])
        with socket.create_connection(("127.0.0.1", fleet_page.port)) as waiting:
            waiting.sendall(b"GET /picture/1 HTTP/1.1\r\nHost: localhost\r\n\r\n")
            with silent.accept()[0]:
                assert press(fleet_page.url, fleet_page.token, "land") == 200
        assert ordered == ["land"]
        assert ask(fleet_page.url, "/picture/1")[0] == 404


# --- who may do what -------------------------------------------------------------------------


def test_each_stop_needs_the_token(fleet_page: FleetPage, ordered: list[str]) -> None:
    fleet_page.show([row(1, "north"), row(2, "east")])
    for button in STOPS:
        assert press(fleet_page.url, "wrong", button) == 403
        assert press(fleet_page.url, fleet_page.token, button, Origin="http://evil.example") == 403
    assert ordered == []
    for button in ("land/0", "land/3", "land/x", "cut/1", "stop"):
        assert press(fleet_page.url, fleet_page.token, button) == 404
    for button in reversed(STOPS):
        assert press(fleet_page.url, fleet_page.token, button) == 200
        assert ordered.pop() == button
    state = state_of(fleet_page)
    assert state["orders"] == "cut"
    assert [vehicle["landed"] for vehicle in state["vehicles"]] == [True, True]


def test_landing_one_leaves_stop_all_as_it_was(fleet_page: FleetPage, ordered: list[str]) -> None:
    fleet_page.show([row(1, "north"), row(2, "east")])
    assert press(fleet_page.url, fleet_page.token, "land/2") == 200
    state = state_of(fleet_page)
    assert (ordered, state["orders"]) == (["land/2"], "ready")
    assert [vehicle["landed"] for vehicle in state["vehicles"]] == [False, True]
