"""benchmarks/recorded_loops.py: what is played is what was recorded, and when."""

from __future__ import annotations

import importlib
import math
import socket
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from perchctl.link import Packet
from perchctl.link.crtp import encode
from perchctl.link.telemetry import telemetry_from_log
from perchctl.vehicle import PositionSetpoint
from tests.helpers.mission import telemetry

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = replace(
    telemetry(1.0, 0.8),
    velocity_mps=(0.1, -0.2, 0.3),
    roll_rad=0.1,
    pitch_rad=-0.2,
    yaw_rad=0.3,
    acc_x_g=0.01,
    acc_y_g=-0.02,
    position_variance_m2=0.4,
    height_variance_m2=0.3,
    velocity_variance_m2ps2=0.2,
    climb_variance_m2ps2=0.1,
    motor_duty=(1, 2, 3, 4),
)


@pytest.fixture(scope="module")
def loops() -> ModuleType:
    folder = str(ROOT / "benchmarks")
    sys.path.insert(0, folder)
    try:
        return importlib.import_module("recorded_loops")
    finally:
        sys.path.remove(folder)


def test_the_link_makes_the_recorded_sample_again(loops: ModuleType) -> None:
    again = telemetry_from_log(loops.log_values(SAMPLE), SAMPLE.t_s)
    assert again == replace(
        SAMPLE,
        roll_rad=again.roll_rad,
        pitch_rad=again.pitch_rad,
        yaw_rad=again.yaw_rad,
        behind_s=0.0,
        battery_behind_s=0.0,
        variance_behind_s=0.0,
    )
    for angle in ("roll_rad", "pitch_rad", "yaw_rad"):
        assert getattr(again, angle) == pytest.approx(getattr(SAMPLE, angle))


def test_the_flight_is_played_from_the_first_setpoint_on(loops: ModuleType) -> None:
    pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
    times_s = [-2.0, -0.5, 0.5, 1.5]
    names = [{"stateEstimate.z": t_s} for t_s in times_s]
    player = loops.Player(loops.Recorded(times_s, names, times_s, [b"a", b"b", b"c", b"d"]))
    begun_s = time.monotonic()

    def shown(at_s: float) -> tuple[float, bytes]:
        player.play(at_s)
        return player._firmware.log_value("stateEstimate.z"), player.stream.newest[1]

    try:
        before = {shown(begun_s + 0.1 * step)[1] for step in range(40)}
        assert before == {b"a", b"b"}, "over and over, what was before take-off"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as loop:
            host, _, port = player.uri.removeprefix("udp://").partition(":")
            (packet,) = encode(PositionSetpoint(0.0, 0.0, 0.5, 0.0))
            assert isinstance(packet, Packet)
            loop.sendto(packet.encode(), (host, int(port)))
            began_s = time.monotonic()
            while player._first_setpoint_s is None and time.monotonic() < began_s + 20.0:
                player.take()
        began_s = player._first_setpoint_s
        assert shown(began_s + 0.1) == (-0.5, b"b")
        assert shown(began_s + 0.6) == (0.5, b"c")
        assert shown(began_s + 1.5) == (1.5, b"d")
        assert shown(began_s + 90.2)[1] in (b"c", b"d"), "its end, over and over"
        assert math.isclose(player._recorded.end_s, 1.5)
    finally:
        player.socket.close()
        player.stream.shutdown()
        player.stream.server_close()
