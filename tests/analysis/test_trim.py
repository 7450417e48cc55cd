"""The motors' trim from a hover: known vehicles, intervals that hold, advice only with reason."""

from __future__ import annotations

import html
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.analysis import FlightAnalysis, show_record, show_text, write_report
from perchctl.analysis.show import COLUMNS
from perchctl.analysis.trim import MOTOR_OFFSET_M, SAMPLE_PERIOD_S, Trim, mean_and_margin
from perchctl.geometry import GRAVITY_MPS2
from perchctl.link import MockLink
from perchctl.link.telemetry import SLOW_PERIOD_S
from perchctl.mission import Phase
from perchctl.profile import load_profile
from perchctl.record import FlightLog, LogWatcher, read_log
from perchctl.record.fields import tick_record
from perchctl.sim import Scenario, SimulatedVehicle, draw_scenario, thrust_n
from perchctl.sim.airframe import CRAZYFLIE_21_BRUSHLESS
from perchctl.sim.powertrain import inverse_thrust, motor_voltage, steady_thrust
from perchctl.vehicle import MOST_DUTY, PositionSetpoint
from tests.helpers import log as synthetic
from tests.helpers.mission import state_with

FORWARD, LEFT, YAW = np.array([[1, -1, -1, 1], [-1, -1, 1, 1], [-1, 1, -1, 1]])
REAL = {"uri": "radio://0/80/2M/E7E7E7E7E7"}
UNEQUAL = (1.08, 0.97, 0.9, 1.05)


def trim_of(log: FlightLog) -> Trim:
    trim = FlightAnalysis(log).trim
    assert trim is not None
    return trim


# --- A simulated vehicle that hovers ---


def hover(path: Path, scenario: Scenario, yaw_rad: float = 0.0, hover_s: float = 4.0) -> FlightLog:
    """The log of a vehicle that climbs to 0.8 m and hovers."""
    link = MockLink(SimulatedVehicle(scenario))
    link.connect()
    writer = LogWatcher.open(path, synthetic.header())
    start_s, climb_s = link.now_s, 3.5
    for tick in range(round((climb_s + hover_s) / synthetic.PERIOD_S)):
        now_s = tick * synthetic.PERIOD_S
        command = PositionSetpoint(0.0, 0.0, min(0.8, 0.3 * now_s), yaw_rad * min(1.0, now_s / 2.0))
        link.send(command)
        link.advance_to(start_s + now_s)
        if samples := link.telemetry():
            state = state_with(phase=Phase.SEARCH)
            writer.write(tick_record(synthetic.tick(start_s + now_s, samples[-1], command, state)))
    writer.end()
    return read_log(writer.path)


def true_trim(scenario: Scenario) -> tuple[float, float, float]:
    """The shift, forward and left (m), and the yaw imbalance, by the balance of moments."""
    x_m, y_m = scenario.centre_of_mass_m
    given = 1.0 + (FORWARD * x_m + LEFT * y_m) / MOTOR_OFFSET_M
    asked = given / np.array(scenario.motor_strength)
    asked /= np.mean(asked)
    pitch, roll, yaw = (float(np.dot(asked, p)) / 4.0 for p in (FORWARD, LEFT, YAW))
    return MOTOR_OFFSET_M * pitch, MOTOR_OFFSET_M * roll, yaw


def misses(trim: Trim, scenario: Scenario) -> NDArray[np.float64]:
    """Distances from the truth, over the margins."""
    found = np.array([*trim.shift_m, trim.yaw_imbalance])
    return np.asarray(np.abs(found - true_trim(scenario)) / [*trim.shift_margin_m, trim.yaw_margin])


@pytest.mark.parametrize(
    "vehicle",
    [
        {},
        {"centre_of_mass_m": (0.002, -0.001)},
        {"motor_strength": (1.1, 0.95, 1.1, 0.95)},
        {"motor_strength": UNEQUAL, "centre_of_mass_m": (-0.001, 0.002)},
        {"motor_strength": UNEQUAL, "battery_rest_v": 3.95},
    ],
)
def test_a_known_vehicle_is_found_again(tmp_path: Path, vehicle: dict[str, Any]) -> None:
    """Without a draught far within its intervals; also the share of each motor."""
    scenario = Scenario(thrust_noise=0.015, motors_brake=True, **vehicle)
    trim = trim_of(hover(tmp_path / "f.jsonl", scenario))
    x_m, y_m, yaw = true_trim(scenario)
    assert trim.shift_m == pytest.approx((x_m, y_m), abs=2e-4)
    assert trim.yaw_imbalance == pytest.approx(yaw, abs=4e-3)
    shares = 1.0 + (FORWARD * x_m + LEFT * y_m) / MOTOR_OFFSET_M + YAW * yaw
    assert trim.shares == pytest.approx(shares, abs=0.01)
    assert max(trim.shift_margin_m) < 1e-3
    assert max(trim.shares_margin) < 0.04


def test_the_heading_makes_no_difference(tmp_path: Path) -> None:
    scenario = Scenario(
        thrust_noise=0.015,
        motors_brake=True,
        motor_strength=UNEQUAL,
        centre_of_mass_m=(0.002, -0.001),
    )
    ahead = trim_of(hover(tmp_path / "a.jsonl", scenario))
    turned = trim_of(hover(tmp_path / "b.jsonl", scenario, yaw_rad=2.0))
    assert turned.shift_m == pytest.approx(ahead.shift_m, abs=2e-4)
    assert turned.shares == pytest.approx(ahead.shares, abs=0.01)


@pytest.mark.long
def test_nearly_all_intervals_hold_the_truth(tmp_path: Path) -> None:
    """Of 20 vehicles drawn as for `perchctl simulate`, each in its own draught, with its own bias
    of the estimated lean: at least 90 % of what should be 95 %."""
    profile = load_profile("sim")
    over = []
    for seed in range(20):
        scenario = draw_scenario(profile, seed)
        trim = trim_of(hover(tmp_path / f"{seed}.jsonl", scenario, hover_s=3.5))
        over.append(misses(trim, scenario))
    assert np.mean(np.array(over) < 1.0) >= 0.9
    assert np.max(over) < 2.5


def test_in_a_wind_the_intervals_are_wide_enough(tmp_path: Path) -> None:
    """It turns the vehicle about all axes: 1 m/s at its strongest."""
    over = []
    for seed in range(6):
        windy = replace(draw_scenario(load_profile("sim"), seed), draught_mps=(0.7, -0.7, 0.0))
        over.append(misses(trim_of(hover(tmp_path / f"{seed}.jsonl", windy)), windy))
    assert np.mean(np.array(over) < 1.0) >= 0.9


@pytest.mark.parametrize(("memory", "count"), [(0.0, 20), (0.4, 35), (0.6, 80), (-0.5, 35)])
def test_the_interval_of_a_mean_knows_the_memory_of_its_noise(memory: float, count: int) -> None:
    """Of 300 series."""
    rng, held = np.random.default_rng(4), 0
    for _ in range(300):
        series = rng.standard_normal(count + 50)
        for i in range(1, len(series)):
            series[i] += memory * series[i - 1]
        mean, margin = mean_and_margin(series[50:], np.ones(count, dtype=bool))
        held += abs(mean) < margin
    assert held >= 0.9 * 300


def test_neighbours_that_oppose_each_other_make_no_narrow_interval() -> None:
    opposed = np.tile([1.0, -1.0], 20)
    _, margin = mean_and_margin(opposed, np.ones(40, dtype=bool))
    assert margin > 1.96 * math.sqrt(1.0 / 40)


# --- Logs with made-up duty cycles ---


def made_up(
    shares: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0),
    *,
    header: dict[str, Any] = REAL,
    volts: float = 3.8,
    noise: float = 0.01,
    seconds: float = 6.0,
    **changes: object,
) -> FlightLog:
    """A log of a hover at 1 m below a target at 2.2 m; `changes`: of each tick's fields."""
    rng = np.random.default_rng(3)
    records: list[dict[str, Any]] = [{"t_s": 0.0, "phase": "APPROACH", "z_m": 0.0}]
    record: dict[str, Any] = {}
    for tick in range(1, round(seconds / synthetic.PERIOD_S)):
        if tick % 5 == 1:
            asked_n = 0.1 * (np.array(shares) + noise * rng.standard_normal(4))
            duties = [motor_voltage(n) / volts * MOST_DUTY for n in asked_n]
            record = {f"duty_m{i}": round(duty) for i, duty in enumerate(duties, start=1)}
        level = dict.fromkeys(("vx_mps", "vy_mps", "vz_mps", "roll_rad", "pitch_rad"), 0.0)
        place = {"t_s": tick * synthetic.PERIOD_S, "phase": "ALIGN", "z_m": 1.0, "tz_m": 2.2}
        records.append({**level, **place, "battery_v": volts, **record, **changes})
    return FlightLog(Path("f.jsonl"), dict(header), records, [], None, True)


def shares_of(x_m: float = 0.0, y_m: float = 0.0, yaw: float = 0.0) -> Any:
    return tuple(1.0 + (FORWARD * x_m + LEFT * y_m) / MOTOR_OFFSET_M + YAW * yaw)


def test_the_same_thrust_from_another_battery_is_the_same_trim() -> None:
    full, low = (trim_of(made_up(shares_of(0.001, 0.002, 0.03), volts=v)) for v in (4.1, 3.5))
    assert low.shares == pytest.approx(full.shares, abs=1e-4)
    assert low.shares_margin == pytest.approx(full.shares_margin, abs=1e-4)


def test_a_lean_widens_what_a_draught_may_cause() -> None:
    """Forward it moves the balance forward, and pushes beside the centre of mass."""
    level, leaning = trim_of(made_up()), trim_of(made_up(pitch_rad=math.radians(2.0)))
    assert leaning.shift_margin_m[0] > 3.0 * level.shift_margin_m[0]
    assert leaning.shift_margin_m[1] == pytest.approx(level.shift_margin_m[1])
    assert leaning.yaw_margin > 3.0 * level.yaw_margin
    assert min(leaning.shares_margin) > 3.0 * min(level.shares_margin)


@pytest.mark.parametrize(
    "changes",
    [
        {"z_m": 0.29},
        {"z_m": 1.91},
        {"vx_mps": 0.16},
        {"vz_mps": -0.31},
        {"roll_rad": 0.08},
        {"duty_m3": None},
        {"duty_m3": 0},
        {"duty_m3": 70_000},
        {"duty_m3": math.nan},
        {"battery_v": None},
        {"battery_v": 0.0},
        {"battery_v": 7.9},
        {"vy_mps": None},
        {f"duty_m{motor}": 9000 for motor in (1, 2, 3, 4)},
        {f"duty_m{motor}": None for motor in (1, 2, 3, 4)},
    ],
)
def test_what_is_no_hover_or_not_known_is_left_out(changes: dict[str, object]) -> None:
    """Of the floor, the ceiling, speed, lean, a duty cycle, the battery; and frozen numbers."""
    log = made_up(**changes)
    assert FlightAnalysis(log).trim is None
    assert show_record(FlightAnalysis(log))["trim"] is None
    assert "motors:" not in show_text(FlightAnalysis(log))


def test_too_short_a_hover_says_nothing() -> None:
    assert FlightAnalysis(made_up(seconds=1.9)).trim is None
    assert trim_of(made_up(seconds=2.2)).hover_s == 2.2


def test_a_sample_lasts_as_long_as_its_log_packet() -> None:
    assert SAMPLE_PERIOD_S == SLOW_PERIOD_S


def test_a_log_without_ticks_or_target_is_no_error() -> None:
    log = made_up()
    assert FlightAnalysis(FlightLog(log.path, log.header, [], [], None, True)).trim is None
    assert trim_of(made_up(tz_m=None)).hover_s == 6.0


def test_propellers_that_idle_on_the_ground_are_no_hover() -> None:
    log = made_up()
    log.records[0] |= {f"duty_m{motor}": 7000 for motor in (1, 2, 3, 4)} | {"battery_v": 4.0}
    assert trim_of(log) == trim_of(made_up())


@pytest.mark.parametrize("mass_kg", [0.040, 0.044, 0.048])
def test_the_thrust_curve_does_for_a_brushless_too(mass_kg: float) -> None:
    """A share follows from the curve's relative slope at the voltage of the hover."""
    brushless = CRAZYFLIE_21_BRUSHLESS.thrust
    hover_v = inverse_thrust(brushless)(mass_kg * GRAVITY_MPS2 / 4.0)
    curve = steady_thrust(brushless)
    own, used = (math.log(f(1.01 * hover_v) / f(0.99 * hover_v)) for f in (curve, thrust_n))
    assert used == pytest.approx(own, rel=0.07)


# --- What is shown, and advised ---


@pytest.mark.parametrize(
    ("shares", "lean_deg", "words"),
    [
        (shares_of(), 0.0, None),
        (shares_of(0.002, -0.002, 0.05), 0.0, None),
        (shares_of(0.004), 0.0, "4.0 +- 0.5 mm forward"),
        (shares_of(-0.004, -0.005), 0.0, "4.0 +- 0.5 mm backward and 5.0 +- 0.5 mm to the right"),
        (shares_of(0.004), 2.0, None),  # a draught may be the cause
        (shares_of(yaw=0.1), 2.0, "front left and back right need +10.0 +- 2.3 % thrust"),
        (shares_of(yaw=-0.1), 0.0, "front right and back left need +10.0 +- 0.5 % thrust"),
    ],
)
def test_advice_needs_an_interval_beyond_the_harmless_range(
    shares: Any, lean_deg: float, words: str | None
) -> None:
    found = trim_of(made_up(shares, pitch_rad=math.radians(lean_deg))).advice
    assert len(found) == (words is not None)
    assert words is None or words in found[0]
    simulated = made_up(shares, header=synthetic.header(), pitch_rad=math.radians(lean_deg))
    assert trim_of(simulated).advice == ()


def test_show_and_report_say_the_same(tmp_path: Path) -> None:
    writer = LogWatcher.open(tmp_path / "flight.jsonl", synthetic.header() | REAL)
    for record in made_up(shares_of(0.004, yaw=-0.02)).records:
        writer.write(record)
    writer.end(synthetic.SUMMARY)
    flight = FlightAnalysis(read_log(writer.path))
    text = " ".join(show_text(flight).split())
    assert max(map(len, show_text(flight).splitlines())) <= COLUMNS
    said = [
        "motors: front right +14.3 +- 2.2 %, back right -14.2 +- 2.2 %, back left -10.3 +- 2.2 %, "
        "front left +10.2 +- 2.2 % relative to the mean thrust (95 %, 6.0 s of level hover)",
        "balance: centre of mass 4.0 +- 0.5 mm forward and 0.0 +- 0.5 mm to the right, if the "
        "motors are equal; weaker motors on that side look the same in flight",
        "yaw: front right and back left +2.0 +- 0.5 %; caused by unequal motors or propellers, or "
        "by a tilted motor, not by the centre of mass",
        "advice: the vehicle flies as if its centre of mass were 4.0 +- 0.5 mm forward: move the "
        "battery the other way and fly again; if the battery is already in the middle, check "
        "the propellers on that side",
    ]
    for line in said:
        assert line in text
    trim = show_record(flight)["trim"]
    assert trim["shift_m"][0] == pytest.approx(0.004, abs=2e-4)
    assert len(trim["shares"]) == len(trim["shares_margin"]) == 4
    report = write_report([writer.path], tmp_path / "report.html")
    assert report.record()[0]["advice"] == list(trim["advice"])
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for line in said:
        assert line.partition(": ")[2][1:] in html.unescape(page)
