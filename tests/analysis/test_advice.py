"""Advice comes with its evidence, and none without it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from perchctl.analysis import FlightAnalysis
from perchctl.analysis.advice import SWING_M, Advice, advice_of, swings_of
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


def test_a_killed_flight_s_latency_is_that_of_its_last_ticks() -> None:
    worked_out = {"delay_s": 0.06, "delay_sigma_s": 0.003}
    worked_out |= {f"turn_{a}_rad": 0.0 for a in "xyz"}
    worked_out |= {f"turn_{a}_sigma_rad": 0.01 for a in "xyz"}
    log = made(quiet, summary=None)
    log.records[300] |= worked_out
    found = FlightAnalysis(log).findings
    assert found is not None
    start_s = log.header["profile"]["camera"]["latency_s"]
    assert found.latency_s == pytest.approx(start_s + 0.06)
    assert len(found.advice) == 1


def swinging(record: dict[str, Any]) -> None:
    quiet(record)
    if record["phase"] == "ALIGN":
        record["ex_m"] = 0.06 * np.cos(2.0 * np.pi * (flown_s(record) - 4.0) / 1.3)


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


def waiting(record: dict[str, Any]) -> None:
    quiet(record)
    if record["phase"] == "ASCEND" and flown_s(record) > 9.0:
        record |= {"ez_m": 0.08, "ex_m": 0.006, "ey_m": 0.0}


def blurred(record: dict[str, Any]) -> None:
    unseen(record)
    record |= {"vx_mps": 1.5 if not record["measured"] else 0.0, "vy_mps": 0.0}


CASES: tuple[tuple[Callable[[dict[str, Any]], None], str, str], ...] = (
    (swinging, "gains", "in ALIGN it swung 6 times across the target, by up to 6.0 cm"),
    (waiting, "gains", "waited 5.0 s at the stand-off, and was within 4.0 mm of the axis for 0 %"),
    (late, "computer", "1 turn in 100 began 15 ms late or more, of a period of 20 ms"),
    (weak, "battery", "it came down to 3.08 V, and at 3.00 V a flight is ended"),
    (silent, "link", "telemetry was older than 300 ms once, at most 580 ms"),
    (no_picture, "video", "once no picture came for more than 0.3 s, at most 1.0 s"),
    (small_print, "print", "the large marker seems 6 % farther away than the small one"),
    (unseen, "light", "their median blur was 0."),
    (blurred, "light", "of them were blurred by more than 2.5 px"),
)


@pytest.mark.parametrize(
    ("change", "about", "evidence"), CASES, ids=lambda c: getattr(c, "__name__", "")
)
def test_each_advice_rests_on_its_figure(change: Change, about: str, evidence: str) -> None:
    assert evidence in advised(change, about).evidence


def test_latency_comes_before_gains() -> None:
    advice = advised(swinging, "gains", summary=SUMMARY | FOUND)
    assert advice.text.startswith("put the latency right first")


def test_a_swing_goes_beyond_on_both_sides() -> None:
    over, under = 2 * SWING_M, SWING_M / 2
    assert swings_of(np.array([over, under, -under, over, np.nan])) == (0, 0.0)
    assert swings_of(np.array([over, -over, under, 3 * over, -over]))[0] == 3
    assert swings_of(np.array([5 * over, -over, over]))[1] == pytest.approx(over)
    assert swings_of(np.array([])) == (0, 0.0)
