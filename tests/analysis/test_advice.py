"""Advice comes with its evidence, and none without it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from perchctl.analysis import FlightAnalysis
from perchctl.analysis.advice import Advice, advice_of
from tests.helpers.log import GONE_S, SUMMARY
from tests.helpers.told import Change, flown_s, made

FOUND = {
    "latency_s": 0.099,
    "latency_sigma_s": 0.003,
    "mount_turn_deg": [0.1, -1.0, -0.4],
    "mount_turn_sigma_deg": [0.3, 0.3, 0.8],
    "advice": ["latency 99 +- 6 ms, profile says 75: set camera.latency_s to 0.099"],
}


def quiet(record: dict[str, Any]) -> None:
    """Nothing to find: the target in sight until the press, and no wait below it."""
    if GONE_S[0] <= flown_s(record) <= GONE_S[1] + 0.05:
        seen(record)
    if record["ez_m"] is not None and record["phase"] == "ASCEND":
        record["ez_m"] = max(record["ez_m"], 0.2)


def seen(record: dict[str, Any]) -> None:
    n = round(flown_s(record) / 0.02)
    record["measured"] = True
    if n % 2 == 0:
        record |= {"frame": n // 2, "frame_t_s": record["t_s"], "lx_m": 0.0}


def unseen(record: dict[str, Any]) -> None:
    quiet(record)
    record |= {"ex_m": 0.0, "ey_m": 0.0} if record["ex_m"] is not None else {}
    if record["phase"] == "ALIGN" and record["frame"] is not None and record["frame"] % 2:
        record |= {f"{s}x_m": None for s in "lsj"} | {"measured": False}


def advised(change: Change, about: str, **more: Any) -> Advice:
    found = [a for a in advice_of(FlightAnalysis(made(change, **more))) if a.about == about]
    assert len(found) == 1, found
    return found[0]


def test_a_quiet_flight_gets_none() -> None:
    assert advice_of(FlightAnalysis(made(quiet))) == ()


def test_what_the_flight_found_is_said_with_its_interval() -> None:
    advice = advised(quiet, "latency", summary=SUMMARY | FOUND)
    assert "99 +- 6 ms" in advice.text
    assert "95 %" in advice.evidence


def late(record: dict[str, Any]) -> None:
    quiet(record)
    record["late_s"] = 0.015 if round(flown_s(record) / 0.02) % 20 == 0 else 0.0


def weak(record: dict[str, Any]) -> None:
    quiet(record)
    record["battery_v"] = 3.08


def silent(record: dict[str, Any]) -> None:
    quiet(record)
    if 7.0 <= flown_s(record) < 7.6:
        record["tel_age_s"] = flown_s(record) - 7.0


def no_picture(record: dict[str, Any]) -> None:
    quiet(record)
    if 7.0 <= flown_s(record) < 8.0:
        record |= {"frame": None, "frame_t_s": None}


def small_print(record: dict[str, Any]) -> None:
    quiet(record)
    if record["sz_m"] is not None:
        record |= {"sz_m": 0.3, "lz_m": 0.318}


def hidden(record: dict[str, Any]) -> None:
    quiet(record)
    record |= {"pos_sent": 100, **{f"pos_{a}_m": record[f"{a}_m"] for a in "xyz"}}
    if 6.0 < record["t_s"] < 7.0:
        record["pos_note"] = "the body is hidden"


def apart(record: dict[str, Any]) -> None:
    quiet(record)
    record |= {"pos_sent": 100, **{f"pos_{a}_m": record[f"{a}_m"] + 0.05 for a in "xyz"}}


CASES: tuple[tuple[Callable[[dict[str, Any]], None], str, str], ...] = (
    (late, "computer", "1 turn in 100 began 15 ms late or more, of a period of 20 ms"),
    (weak, "battery", "it came down to 3.08 V, and at 3.00 V a flight is ended"),
    (silent, "link", "telemetry was older than 300 ms once, at most 580 ms"),
    (no_picture, "video", "once no picture came for more than 0.3 s, at most 1.0 s"),
    (small_print, "print", "the large marker seems 6 % farther away than the small one"),
    (hidden, "positioning", "once no position was sent, at most for 1.0 s: the body is hidden"),
    (apart, "positioning", "the vehicle's estimate was 8.7 cm from the positions from outside"),
    (unseen, "light", "frames did not show the target, though it was overhead"),
)


@pytest.mark.parametrize(
    ("change", "about", "evidence"), CASES, ids=lambda c: getattr(c, "__name__", "")
)
def test_each_advice_rests_on_its_figure(change: Change, about: str, evidence: str) -> None:
    assert evidence in advised(change, about).evidence
