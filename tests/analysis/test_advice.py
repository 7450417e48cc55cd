"""Advice comes with its evidence, and none without it."""

from __future__ import annotations

from typing import Any

import pytest

from perchctl.analysis import FlightAnalysis
from perchctl.analysis.story import advice_of
from tests.helpers.log import GONE_S, SUMMARY
from tests.helpers.told import flown_s, made

FOUND = {
    "latency_s": 0.099,
    "latency_sigma_s": 0.003,
    "mount_turn_deg": [0.1, -1.0, -0.4],
    "mount_turn_sigma_deg": [0.3, 0.3, 0.8],
    "advice": ["latency 99 +- 6 ms, profile says 75: set camera.latency_s to 0.099"],
}


def quiet(record: dict[str, Any]) -> None:
    """Nothing to find: a picture in every other tick."""
    n = round(flown_s(record) / 0.02)
    if GONE_S[0] <= flown_s(record) <= GONE_S[1] + 0.05 and n % 2 == 0:
        record |= {"frame": n // 2, "frame_t_s": record["t_s"], "lx_m": 0.0, "measured": True}


def late(record: dict[str, Any]) -> None:
    record["late_s"] = 0.015 if round(flown_s(record) / 0.02) % 20 == 0 else 0.0


def weak(record: dict[str, Any]) -> None:
    record["battery_v"] = 3.08


def silent(record: dict[str, Any]) -> None:
    if 7.0 <= flown_s(record) < 7.6:
        record["tel_age_s"] = flown_s(record) - 7.0


def no_picture(record: dict[str, Any]) -> None:
    if 7.0 <= flown_s(record) < 8.0:
        record |= {"frame": None, "frame_t_s": None}


def small_print(record: dict[str, Any]) -> None:
    if record["sz_m"] is not None:
        record |= {"sz_m": 0.3, "lz_m": 0.318}


CASES: dict[str, tuple[Any, str]] = {
    "computer": (late, "1 turn in 100 began 15 ms late or more, of a period of 20 ms"),
    "battery": (weak, "it came down to 3.08 V, and at 3.00 V a flight is ended"),
    "link": (silent, "telemetry was older than 0.3 s, at most 0.58 s"),
    "video": (no_picture, "1 gap of more than 0.3 s without a picture, at most 1.0 s"),
    "print": (small_print, "the large marker seems 6 % farther than the small one"),
    "latency": (quiet, "95 %"),
}


@pytest.mark.parametrize("about", CASES)
def test_each_advice_rests_on_its_figure(about: str) -> None:
    change, evidence = CASES[about]

    def changed(record: dict[str, Any]) -> None:
        quiet(record)
        change(record)

    end = SUMMARY | (FOUND if about == "latency" else {})
    (advice,) = advice_of(FlightAnalysis(made(changed, end)))
    assert advice.about == about
    assert evidence in advice.evidence


def test_a_quiet_flight_gets_none() -> None:
    assert advice_of(FlightAnalysis(made(quiet))) == ()
