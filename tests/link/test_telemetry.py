"""Log blocks at the edge: signs, time, a sample that is as old as its oldest part, and the samples
of a vehicle that is moved by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.errors import TimedOut
from perchctl.link import AttitudeLink, telemetry
from perchctl.link.listening import MOTION_BLOCK, ReadOnlyLink
from perchctl.link.telemetry import (
    BLOCKS,
    MOST_CARRIED_S,
    NEEDED,
    WRAP_MS,
    LogBlocks,
    SampleAssembler,
    Timebase,
    telemetry_from_log,
)
from perchctl.profile import LinkConfig
from perchctl.vehicle import ARMED, AUTO_ARM, CAN_FLY, FLYING


def test_pitch_and_degrees_turn_at_the_edge() -> None:
    """stateEstimate.pitch is nose up in degrees; inside it is nose down in radians."""
    values = dict.fromkeys(NEEDED, 0.0) | {
        "stateEstimate.roll": 10.0,
        "stateEstimate.pitch": 20.0,
        "stateEstimate.yaw": 30.0,
        "supervisor.info": 0x021E,
    }
    sample = telemetry_from_log(values, 1.5)
    assert sample.roll_rad == pytest.approx(math.radians(10))
    assert sample.pitch_rad == pytest.approx(-math.radians(20))
    assert sample.yaw_rad == pytest.approx(math.radians(30))
    assert sample.supervisor == 0x021E
    assert sample.t_s == 1.5
    assert sample.battery_v == 0.0  # unknown, which to the planner is not empty


VARIANCES = {
    "kalman.varX": 6e-4, "kalman.varY": 7e-4, "kalman.varZ": 5e-4,
    "kalman.varPX": 3e-4, "kalman.varPY": 2e-4, "kalman.varPZ": 1e-4,
}  # fmt: skip


def variances_of(values: dict[str, float]) -> tuple[float | None, ...]:
    """Of the position, of the height, of the velocity and of the climb."""
    sample = telemetry_from_log(dict.fromkeys(NEEDED, 0.0) | values, 1.5)
    return (
        sample.position_variance_m2,
        sample.height_variance_m2,
        sample.velocity_variance_m2ps2,
        sample.climb_variance_m2ps2,
    )


def test_each_variance_has_its_own_name() -> None:
    """`varX` to `varZ` are of the position, `varPX` to `varPZ` of the velocity (docs/firmware.md,
    "Variances"); what is not there, or was never written, is not small but unknown."""
    assert variances_of({}) == (None, None, None, None)
    assert variances_of(VARIANCES) == (7e-4, 5e-4, 3e-4, 1e-4)
    assert variances_of(dict.fromkeys(VARIANCES, 0.0)) == (None, None, None, None)
    place, height, speed, climb = variances_of(VARIANCES | {"kalman.varZ": math.nan})
    assert (math.isnan(place or 0.0), math.isnan(height or 0.0)) == (True, True)
    assert (speed, climb) == (3e-4, 1e-4)


DUTIES = {"motor.m1": 1.0, "motor.m2": 20_000.0, "motor.m3": 0.0, "motor.m4": 65_535.0}


def duty_of(values: dict[str, float]) -> tuple[int, ...] | None:
    return telemetry_from_log(dict.fromkeys(NEEDED, 0.0) | values, 1.5).motor_duty


@pytest.mark.parametrize("odd", [math.nan, math.inf, -1.0, 65_536.0, None])
def test_four_duty_cycles_or_none(odd: float | None) -> None:
    """An absent or odd one is unknown, and the sample is whole without it."""
    assert duty_of(DUTIES) == (1, 20_000, 0, 65_535)
    others = {name: duty for name, duty in DUTIES.items() if name != "motor.m3"}
    assert duty_of(others if odd is None else others | {"motor.m3": odd}) is None


@pytest.mark.parametrize("lacks", [None, "motor.m2", "pm.vbat"])
def test_firmware_without_a_duty_cycle_still_reports_its_battery(
    monkeypatch: pytest.MonkeyPatch, lacks: str | None
) -> None:
    """A block with a variable that the firmware lacks would be refused as a whole."""
    started: dict[str, list[str]] = {}

    def start(log: object, uri: str, name: str, variables: dict[str, str], *_: object) -> None:
        started[name] = list(variables)

    monkeypatch.setattr(telemetry, "start_block", start)
    monkeypatch.setattr(telemetry, "_starting", lambda log, block: [])
    monkeypatch.setattr(telemetry, "FIRST_SAMPLE_TIMEOUT_S", 0.0)
    toc = SimpleNamespace(get_element_by_complete_name=lambda n: None if n == lacks else object())
    with pytest.raises(TimedOut):
        LogBlocks(lambda: 0.0).start(SimpleNamespace(toc=toc), "usb://0", 0.01)
    battery = ["pm.vbat", "pm.state"]
    expected = {None: [*battery, *DUTIES], "motor.m2": battery, "pm.vbat": None}[lacks]
    assert started.get("battery") == expected
    assert {"state", "attitude", "variance"} <= started.keys()


def test_each_log_block_fits_into_a_packet() -> None:
    """26 bytes (docs/firmware.md, "Link")."""
    size = {"float": 4, "FP16": 2, "uint16_t": 2, "int8_t": 1}
    sizes = {name: sum(size[kind] for kind in block.values()) for name, block in BLOCKS.items()}
    assert max(sizes.values()) <= 26, sizes


@given(
    start_ms=st.integers(0, WRAP_MS - 1),
    delays_ms=st.lists(st.integers(0, 80), min_size=20, max_size=60),
)
def test_timebase_follows_stamps_not_arrivals(start_ms: int, delays_ms: list[int]) -> None:
    """Also across the wrap of the three-byte stamp; the best delivery sets the offset."""
    base = Timebase()
    times = []
    for i, delay_ms in enumerate(delays_ms):
        stamp = (start_ms + 10 * i) % WRAP_MS
        times.append(base.to_loop_s(stamp, 100.0 + 0.01 * i + 0.001 * delay_ms))
    best_s = min(delays_ms) / 1000.0
    after = delays_ms.index(min(delays_ms))
    for i in range(after, len(times)):
        assert times[i] == pytest.approx(100.0 + 0.01 * i + best_s, abs=2e-4)


def test_a_vehicle_that_has_started_again_is_followed_from_its_first_stamp_on() -> None:
    """Packets that overtake each other are no new start."""
    base = Timebase()
    assert base.to_loop_s(60_000, 100.0) == pytest.approx(100.0)
    assert base.to_loop_s(59_990, 100.0) == pytest.approx(99.99)
    assert base.start == 0
    assert base.to_loop_s(300, 103.0) == pytest.approx(103.0)
    assert base.to_loop_s(310, 103.02) == pytest.approx(103.01)
    assert base.start == 1


STILL = {name: dict.fromkeys(variables, 0.0) for name, variables in BLOCKS.items()}


def test_nothing_without_both_fast_blocks() -> None:
    assembler = SampleAssembler()
    assert assembler.accept("attitude", STILL["attitude"], 0.0) is None
    assert assembler.accept("state", STILL["state"], 0.01) is None
    assert assembler.accept("attitude", STILL["attitude"], 0.01) is not None


@given(silent_ms=st.integers(0, 3000), speed_mps=st.floats(-1, 1))
def test_a_dead_block_shows_in_the_sample(silent_ms: int, speed_mps: float) -> None:
    assembler = SampleAssembler()
    assembler.accept("state", STILL["state"] | {"stateEstimate.vz": speed_mps}, 1.0)
    sample = assembler.accept("attitude", STILL["attitude"], 1.0 + silent_ms / 1e3)
    assert sample is not None
    assert sample.behind_s == pytest.approx(silent_ms / 1e3)
    carried_m = speed_mps * min(silent_ms / 1e3, MOST_CARRIED_S)
    assert sample.position_m[2] == pytest.approx(carried_m)


def test_a_dead_slow_block_shows_in_the_sample() -> None:
    """What never came is not there, what came once grows old."""
    assembler = SampleAssembler()

    def ages(t_s: float, start: int = 0) -> tuple[float, float]:
        assembler.accept("state", STILL["state"], t_s, start)
        sample = assembler.accept("attitude", STILL["attitude"], t_s, start)
        assert sample is not None
        return sample.battery_behind_s, sample.variance_behind_s

    assert ages(1.0) == (math.inf, math.inf)
    assembler.accept("battery", STILL["battery"], 1.0)
    assert ages(1.5) == (0.5, math.inf)
    assembler.accept("variance", STILL["variance"], 1.7)
    assert ages(3.0) == pytest.approx((2.0, 1.3))
    assert ages(0.1, start=1) == (math.inf, math.inf)


def test_what_a_vehicle_told_before_it_started_anew_is_over() -> None:
    assembler = SampleAssembler()
    assembler.accept("state", STILL["state"], 1.0)
    assert assembler.accept("attitude", STILL["attitude"], 2.0, 1) is None
    assembler.accept("state", STILL["state"], 2.01, 1)
    assert assembler.accept("attitude", STILL["attitude"], 1.01, 0) is None  # it came late
    sample = assembler.accept("attitude", STILL["attitude"], 2.02, 1)
    assert sample is not None
    assert (sample.start, sample.behind_s) == (1, pytest.approx(0.01))


# --- A vehicle that is moved by hand: the link itself is tested by the command that uses it, in
# tests/calibration/test_mount_live.py


AT_REST = dict.fromkeys(MOTION_BLOCK, 0.0)


class Listened(AttitudeLink):
    """A link whose block sends when the test says so; `now_s` is its clock."""

    def __init__(self) -> None:
        super().__init__("usb://0", LinkConfig(), lambda: self.now_s)
        self.now_s = 5.0

    def hear(self, **values: float) -> None:
        self._on_motion(round(1000 * self.now_s), AT_REST | values)


def test_whether_motors_turn_is_the_newest_packet_s() -> None:
    """A link that only listens sends nothing for it."""
    ReadOnlyLink("usb://0", LinkConfig(), float)._prepare(None)  # type: ignore[arg-type]
    link = Listened()
    armed_itself, armed_by_somebody = CAN_FLY | ARMED | AUTO_ARM, CAN_FLY | ARMED
    for bits, turn in (
        (FLYING, True), (0, False), (FLYING | ARMED, True),
        (armed_itself, False), (armed_by_somebody, True),
    ):  # fmt: skip
        link.hear(**{"supervisor.info": bits, "gyro.x": math.nan})
        assert link.motors_running == turn


def test_samples_are_in_radians_right_handed_and_of_one_moment() -> None:
    link = Listened()
    turned = {"stateEstimate.roll": 10.0, "stateEstimate.pitch": 20.0, "stateEstimate.yaw": -30.0}
    rates = {"gyro.x": 1.0, "gyro.y": 2.0, "gyro.z": 3.0}
    link.hear(**turned, **rates)
    link.now_s += 0.015
    link.hear(**turned, **rates)
    first, second = link.samples()
    assert second.t_s - first.t_s == pytest.approx(0.015)
    rpy = (second.roll_rad, second.pitch_rad, second.yaw_rad)
    assert rpy == pytest.approx(np.radians([10.0, -20.0, -30.0]))
    assert second.gyro_radps == pytest.approx(np.radians([1.0, 2.0, 3.0]))
    assert link.samples() == []


@pytest.mark.parametrize("name", [name for name in MOTION_BLOCK if name != "supervisor.info"])
@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_turn_that_is_no_number_is_dropped_alone(name: str, number: float) -> None:
    """One in a carry would make all of it unsolvable."""
    link = Listened()
    for broken in ({}, {name: number}, {}):
        link.hear(**broken)
        link.now_s += 0.01
    taken = link.samples()
    assert len(taken) == 2
    assert np.isfinite([[a.roll_rad, a.pitch_rad, a.yaw_rad, *a.gyro_radps] for a in taken]).all()
