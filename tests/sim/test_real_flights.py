"""benchmarks/real_flights.py: each estimator finds what was put into a record, a file is read as
it was written, and the simulator's own flight lies where the recorded ones do."""

from __future__ import annotations

import importlib
import math
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from perchctl.geometry import GRAVITY_MPS2, Array
from perchctl.sim import Scenario
from perchctl.sim.powertrain import (
    MOTOR_CURRENT_A,
    MOTOR_FORCE_N,
    RESISTANCE_OHM,
    motor_voltage,
)
from perchctl.sim.world import (
    ARM_M,
    INERTIA_REFERENCE_KG,
    INERTIA_REFERENCE_KGM2,
)
from tests.helpers.flights import ROOT

ROW_S = 0.01
ROWS, BEGIN, END = 2500, 200, 2400
LIFT = BEGIN + 50
MASS_KG = 0.044
RADIUS_M, TURNS_PER_S = 0.8, 0.1
W_RADPS = 2.0 * math.pi * TURNS_PER_S
HEADING_RAD = 0.7


@pytest.fixture(scope="module")
def flight() -> ModuleType:
    return _benchmark("recorded_flight")


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    return _benchmark("real_flights")


def _benchmark(name: str) -> ModuleType:
    folder = str(ROOT / "benchmarks")
    sys.path.insert(0, folder)
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(folder)


T_S = ROW_S * np.arange(ROWS)
FLOWN = (np.arange(ROWS) >= BEGIN) & (np.arange(ROWS) < END)


def duties(torque_x: Array, torque_y: Array, battery_v: Array, thrust_n: Array) -> Array:
    """The duty cycles that ask for these torques and this thrust, by perchctl's curve."""
    arm = 4.0 * ARM_M * math.sqrt(0.5)
    x, y, f = torque_x / arm, torque_y / arm, thrust_n / 4.0
    forces = np.stack([f - x - y, f - x + y, f + x + y, f + x - y], axis=1)
    grid_n = np.linspace(0.0, 0.2, 500)
    grid_v = [motor_voltage(float(n)) for n in grid_n]
    volts = np.interp(forces, grid_n, grid_v)
    return np.asarray(np.where(FLOWN[:, None], volts / battery_v[:, None], 0.0))


def circle(flight: ModuleType, **changed: Any) -> Any:
    """A flight in circles 1 m up, without noise, with a constant heading; it rises at `LIFT`."""
    z = np.where(FLOWN & (np.arange(ROWS) >= LIFT), 1.0, 0.05)
    xy = RADIUS_M * np.stack([np.cos(W_RADPS * T_S), np.sin(W_RADPS * T_S)], axis=1)
    battery_v = np.full(ROWS, 4.0)
    still = np.zeros(ROWS)
    thrust_n = np.full(ROWS, MASS_KG * GRAVITY_MPS2)
    values = {
        "name": "circle",
        "position_m": np.column_stack([xy, z]),
        "rpy_rad": np.tile((0.0, 0.0, HEADING_RAD), (ROWS, 1)),
        "estimated_rpy_rad": np.tile((0.0, 0.0, HEADING_RAD), (ROWS, 1)),
        "setpoint": np.column_stack([xy, z, still]),
        "gyro_radps": np.zeros((ROWS, 3)),
        "acc_g": np.tile((0.0, 0.0, 1.0), (ROWS, 1)),
        "duty": duties(still, still, battery_v, thrust_n),
        "battery_v": battery_v,
    }
    return flight.Recording(**(values | changed))


def velocity_ahead_left() -> Array:
    """(n, 2): of the circle, in the vehicle's level axes."""
    angle = W_RADPS * T_S + math.pi / 2.0 - HEADING_RAD
    return np.asarray(W_RADPS * RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def white(seed: int, *shape: int) -> Array:
    return np.random.default_rng(seed).standard_normal(shape)


def test_a_record_knows_its_flight_and_its_mass(flight: ModuleType) -> None:
    r = circle(flight)
    assert (r.begin, r.end, r.lift_off) == (BEGIN, END, LIFT)
    assert r.unusable() is None
    assert r.mass_kg() == pytest.approx(MASS_KG, rel=1e-3)
    assert r.rest_v == 4.0


@pytest.mark.parametrize(
    ("reason", "changed"),
    [
        ("the motors never ran", {"duty": np.zeros((ROWS, 4))}),
        ("not flown by the PID controller", {"by_pid": False}),
        ("crashed", {"rpy_rad": np.tile((0.0, 1.2, 0.0), (ROWS, 1))}),
        ("crashed", {"duty": np.full((ROWS, 4), 0.5)}),
        ("too short", {"position_m": np.zeros((ROWS, 3))}),
    ],
)
def test_a_record_that_cannot_be_compared_says_why(
    flight: ModuleType, reason: str, changed: dict[str, Any]
) -> None:
    assert circle(flight, **changed).unusable() == reason


def test_tracking_delay_and_error(flight: ModuleType) -> None:
    r = circle(flight)
    late_s = 0.537
    angle = W_RADPS * (T_S - late_s)
    at = RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    r = replace(r, position_m=np.column_stack([at, r.position_m[:, 2]]))
    assert flight.tracking_delay_ms(r) == pytest.approx(537.0, abs=1.0)
    chord_m = 2.0 * RADIUS_M * math.sin(0.5 * W_RADPS * late_s)
    assert flight.tracking_rms_m(r) == pytest.approx(chord_m, rel=1e-3)
    hover = replace(r, setpoint=np.tile((0.0, 0.0, 1.0, 0.0), (ROWS, 1)))
    assert math.isnan(flight.tracking_delay_ms(hover))


def test_take_off(flight: ModuleType) -> None:
    """Lift-off after 1 s, then a straight climb of 1 m in 1 s that overshoots by 0.15 m."""
    after_s = T_S - T_S[BEGIN]
    z = np.interp(after_s, (1.0, 2.15, 2.5), (0.05, 1.2, 1.05))
    wanted_z = np.interp(after_s, (0.0, 2.0), (0.05, 1.05))
    rising = np.clip((after_s - 1.0) / 1.0, 0.0, 1.0)
    position = np.column_stack([0.3 + 0.03 * rising, -0.1 + 0.04 * rising, z])
    rpy = np.column_stack([0.01 + 0.02 * rising, 0.01 * rising, HEADING_RAD - 0.1 * rising])
    setpoint = np.column_stack([np.zeros((ROWS, 2)), wanted_z, np.zeros(ROWS)])
    r = circle(flight, position_m=position, rpy_rad=rpy, setpoint=setpoint)
    assert flight.lift_off_s(r) == pytest.approx(1.02, abs=0.011)
    assert flight.take_off_run_mm(r) == pytest.approx(50.0, abs=0.1)
    assert flight.take_off_turn_deg(r) == pytest.approx(math.degrees(0.1), rel=1e-3)
    assert flight.take_off_tilt_deg(r) == pytest.approx(math.degrees(math.hypot(0.02, 0.01)))
    assert flight.overshoot_m(r) == pytest.approx(0.15, abs=1e-6)
    assert flight.rise_s(r) == pytest.approx(0.8, abs=0.011)
    wanted_z = np.interp(after_s, (0.0, 20.0), (0.05, 2.0))  # goes on rising
    r = circle(flight, position_m=position, setpoint=setpoint * (1, 1, 0, 1) + wanted_z[:, None])
    assert math.isnan(flight.overshoot_m(r))


def test_drag_is_the_force_against_the_motion(flight: ModuleType) -> None:
    acc = np.column_stack([-0.38 * velocity_ahead_left() / GRAVITY_MPS2, np.ones(ROWS)])
    acc[:, :2] += (0.02, -0.01) + 0.02 * white(1, ROWS, 2)  # biases and vibration
    assert flight.drag_per_s(circle(flight, acc_g=acc)) == pytest.approx(0.38, rel=0.03)
    assert math.isnan(flight.drag_per_s(circle(flight, position_m=np.zeros((ROWS, 3)))))


@pytest.mark.parametrize("axis", [0, 1])
def test_authority_and_lag(flight: ModuleType, axis: int) -> None:
    """Half the angular acceleration that the torque should give, 30 ms of lag and 20 ms late."""
    torque = 2e-4 * flight.low_pass(white(2, ROWS), 5.0)
    level = np.zeros(ROWS)
    asked = (torque, level) if axis == 0 else (level, torque)
    volts, thrust = np.full(ROWS, 4.0), np.full(ROWS, MASS_KG * GRAVITY_MPS2)
    inertia = INERTIA_REFERENCE_KGM2[axis] * MASS_KG / INERTIA_REFERENCE_KG
    answer = 0.5 * np.roll(flight.lagged(torque, 0.03), 2) / inertia
    gyro = np.zeros((ROWS, 3))
    gyro[:, axis] = np.cumsum(answer) * ROW_S
    r = circle(flight, duty=duties(*asked, volts, thrust), gyro_radps=gyro)
    found = flight.authority(r, axis)
    assert found.ratio == pytest.approx(0.5, rel=0.1)  # lag and ratio trade off
    assert found.lag_ms == pytest.approx(50.0, abs=11.0)


def test_imbalance(flight: ModuleType) -> None:
    r = circle(flight)
    each_n = MASS_KG * GRAVITY_MPS2 / 4.0 * np.array([1.03, 0.97, 1.085, 0.915])
    volts = np.array([motor_voltage(float(n)) for n in each_n])
    r = replace(r, duty=np.where(FLOWN[:, None], volts / 4.0, 0.0))
    assert flight.imbalance_percent(r) == pytest.approx(17.0, abs=0.1)


def test_noise_of_the_sensors(flight: ModuleType) -> None:
    """White noise fills the band up to 50 Hz evenly; slow motion does not count."""
    slow = np.sin(2.0 * math.pi * 2.0 * T_S)[:, None]
    gyro = np.radians(white(3, ROWS, 3) * (1.0, 1.0, 0.3) + 20.0 * slow)
    acc = 0.01 * white(4, ROWS, 3) + 0.1 * slow + (0.0, 0.0, 1.0)
    r = circle(flight, gyro_radps=gyro, acc_g=acc)
    assert flight.gyro_noise_dps(r, (0, 1)) == pytest.approx(math.sqrt(0.6), rel=0.08)
    assert flight.gyro_noise_dps(r, (2,)) == pytest.approx(0.3 * math.sqrt(0.6), rel=0.08)
    assert flight.acc_noise_g(r) == pytest.approx(0.01 * math.sqrt(42.0 / 50.0), rel=0.08)


def test_battery(flight: ModuleType) -> None:
    thrust_n = np.full(ROWS, MASS_KG * GRAVITY_MPS2)
    amperes = MOTOR_CURRENT_A / MOTOR_FORCE_N * MASS_KG * GRAVITY_MPS2
    since_s = np.clip(T_S - T_S[BEGIN], 0.0, None)
    volts = 4.17 - FLOWN * 0.15 * amperes - 0.0035 * since_s
    r = circle(flight, battery_v=volts, duty=duties(0.0 * T_S, 0.0 * T_S, volts, thrust_n))
    assert flight.sag_ohm(r) == pytest.approx(0.15 + 1.5 * 0.0035 / amperes, rel=0.01)
    assert flight.discharge_mv_per_s(r) == pytest.approx(3.5, rel=0.01)


@pytest.mark.parametrize("axis", [0, 1])
def test_estimated_tilt(flight: ModuleType, axis: int) -> None:
    """What counts is the scatter: neither a mounting nor a clock that is 30 ms off."""
    true = 0.05 * np.sin(2.0 * math.pi * 0.7 * T_S)
    wrong = np.radians(1.2) * np.sqrt(2.0) * np.sin(2.0 * math.pi * 0.11 * T_S)
    rpy, estimated = np.zeros((2, ROWS, 3))
    rpy[:, axis] = true + 0.02
    estimated[:, axis] = np.roll(true, 3) + wrong
    r = circle(flight, rpy_rad=rpy, estimated_rpy_rad=estimated)
    assert flight.tilt_error_deg(r, axis) == pytest.approx(1.2, rel=0.05)
    assert flight.tilt_error_deg(r, 1 - axis) == pytest.approx(0.0, abs=1e-9)


def test_moment_by_speed_lifts_the_side_that_leads(flight: ModuleType) -> None:
    """The motors hold the moment: in forward flight they push the nose down."""
    ahead, left = velocity_ahead_left().T
    volts, thrust = np.full(ROWS, 4.0), np.full(ROWS, MASS_KG * GRAVITY_MPS2)
    offset = np.full(ROWS, 1e-4)  # of a centre of mass off the middle
    r = circle(flight, duty=duties(-0.7e-3 * left + offset, 0.8e-3 * ahead + offset, volts, thrust))
    assert flight.moment_nm_per_mps(r, 0) == pytest.approx(0.7e-3, rel=0.02)
    assert flight.moment_nm_per_mps(r, 1) == pytest.approx(0.8e-3, rel=0.02)


def test_ground_effect(flight: ModuleType) -> None:
    """9 % less thrust up to 3 cm, 4 % less up to 7 cm, in a slow climb and descent."""
    after_s = T_S - T_S[BEGIN]
    rise_m = np.interp(after_s, (0.0, 8.0, 14.0, 22.0), (0.0, 0.4, 0.4, 0.0))
    share = np.where(rise_m < 0.03, 0.91, np.where(rise_m < 0.07, 0.96, 1.0))
    volts = np.full(ROWS, 4.0)
    r = circle(
        flight,
        position_m=np.column_stack([np.zeros((ROWS, 2)), 0.05 + rise_m]),
        duty=duties(0.0 * T_S, 0.0 * T_S, volts, share * MASS_KG * GRAVITY_MPS2),
    )
    assert flight.ground_effect(r, 0) == pytest.approx(0.91, abs=0.01)
    assert flight.ground_effect(r, 1) == pytest.approx(0.96, abs=0.01)


# --- Files ---


def write_nanobench(flight: ModuleType, r: Any, path: Path) -> None:
    """Write a record in NanoBench's layout, with a column more than is read."""
    pitch_up = np.degrees(r.estimated_rpy_rad) * (1.0, -1.0, 1.0)
    setpoint = np.column_stack([r.setpoint[:, :3], np.degrees(r.setpoint[:, 3])])
    parts = (
        *(ROW_S * np.arange(len(r.duty)), r.position_m, r.rpy_rad, r.gyro_radps, r.acc_g),
        *(65535.0 * r.duty, pitch_up, setpoint, np.full(len(r.duty), 40000.0), r.battery_v),
    )
    table = np.column_stack([*parts, np.zeros(len(r.duty))])
    header = ",".join((*flight.COLUMNS, "qx"))
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.9f")


def test_a_file_is_read_as_it_was_written(flight: ModuleType, tmp_path: Path) -> None:
    r = circle(
        flight,
        estimated_rpy_rad=white(5, ROWS, 3),
        rpy_rad=white(6, ROWS, 3),
        setpoint=white(7, ROWS, 4),
        gyro_radps=white(8, ROWS, 3),
    )
    write_nanobench(flight, r, tmp_path / "circle.csv")
    (found,) = flight.read_recordings(tmp_path / "circle.csv")
    for name in ("position_m", "rpy_rad", "estimated_rpy_rad", "setpoint", "gyro_radps", "acc_g"):
        assert getattr(found, name) == pytest.approx(getattr(r, name), abs=1e-8), name
    assert found.duty == pytest.approx(r.duty, abs=1e-8)
    assert (found.name, found.by_pid, found.has_setpoints) == ("circle", True, True)


def test_a_file_of_neural_swarm_is_cut_into_its_flights(flight: ModuleType, tmp_path: Path) -> None:
    rows = 1200
    t_s = ROW_S * np.arange(rows)
    spins = ((t_s > 0.05) & (t_s < 5.0)) | ((t_s > 6.0) & (t_s < 11.5))
    columns = dict.fromkeys(flight.SWARM_COLUMNS, np.zeros(rows))
    columns |= {"time[ms]": 1e6 * t_s + 9e3, "qw": np.ones(rows), "Vbat[V]": np.full(rows, 4.1)}
    columns |= {"az[m/s^2]": np.full(rows, GRAVITY_MPS2), "z[m]": np.where(spins, 0.55, 0.05)}
    columns |= dict.fromkeys(flight.SWARM_DUTY, 0.6 * spins)
    folder = tmp_path / "takeoff_s"
    folder.mkdir()
    table, header = np.column_stack(list(columns.values())), ",".join(columns)
    np.savetxt(folder / "cf50_00.csv", table, delimiter=",", header=header)
    first, second = flight.read_recordings(folder / "cf50_00.csv")
    assert [first.unusable(), second.unusable()] == [None, None]
    assert (first.end - first.begin) * ROW_S == pytest.approx(4.95, abs=0.03)
    assert (second.end - second.begin) * ROW_S == pytest.approx(5.5, abs=0.03)
    assert second.acc_g[:, 2] == pytest.approx(1.0)
    assert math.isnan(flight.tracking_rms_m(first))
    np.savetxt(tmp_path / "cf50_00.csv", table, delimiter=",", header=header)
    assert flight.read_recordings(tmp_path / "cf50_00.csv") == []  # several vehicles in the air


# --- The simulator's own flight ---

SCENARIO = Scenario(
    mass_kg=MASS_KG, no_target=True, ceiling_z_m=4.0, extra={"external_position": 1.0}
)


def planned(flight: ModuleType, end_s: float, xy_m: Array) -> Any:
    """A record with these setpoints from 4 s after the motors' start, and `end_s` of motors."""
    after_s = T_S - T_S[BEGIN]
    running = (after_s > -1e-6) & (after_s < end_s)
    z = np.interp(after_s, (0.0, 2.0), (0.012, 1.012))
    setpoint = np.column_stack([np.where(after_s[:, None] > 4.0, xy_m, 0.0), z, np.zeros(ROWS)])
    r = circle(flight, setpoint=np.where(running[:, None], setpoint, 0.0))
    return replace(r, duty=np.where(running[:, None], 0.6, 0.0))


@pytest.fixture(scope="module")
def flown(bench: ModuleType, flight: ModuleType) -> Any:
    """A take-off to 1 m and one circle of 0.8 m, flown by the default vehicle."""
    angle = W_RADPS * (T_S - T_S[BEGIN] - 4.0)
    xy_m = RADIUS_M * np.stack([np.sin(angle), 1.0 - np.cos(angle)], axis=1)
    return bench.replay(planned(flight, 13.0, xy_m), SCENARIO)


def test_a_replay_repeats_the_model(flight: ModuleType, flown: Any) -> None:
    """The estimators find the simulator's own constants in its log."""
    assert flown.unusable() is None
    assert flown.begin == pytest.approx(BEGIN, abs=2)
    assert flown.mass_kg() == pytest.approx(MASS_KG, rel=0.01)
    assert flight.drag_per_s(flown) == pytest.approx(Scenario().drag_nspm / MASS_KG, rel=0.2)
    assert flight.sag_ohm(flown) == pytest.approx(RESISTANCE_OHM, abs=0.015)


def test_a_replay_lies_where_recorded_flights_do(flight: ModuleType, flown: Any) -> None:
    """10th to 90th percentile of 47 flights of NanoBench (docs/real-flights.md)."""
    assert 478.0 < flight.tracking_delay_ms(flown) < 604.0
    assert 0.131 < flight.sag_ohm(flown) < 0.222
    assert 2.6 < flight.discharge_mv_per_s(flown) < 6.7


def test_fluctuating_thrust_hides_the_authority(bench: ModuleType, flight: ModuleType) -> None:
    """2 % of fluctuation, and the regression finds the authority of recorded flights (0.35..0.73,
    docs/real-flights.md), though nothing else has changed: it finds the controller's answer to the
    fluctuation. Without it, steps of the setpoint show the true authority."""
    rng = np.random.default_rng(9)
    steps_m = np.repeat(rng.uniform(-0.15, 0.15, (ROWS // 70 + 1, 2)), 70, axis=0)[:ROWS]
    r = planned(flight, 11.2, steps_m)
    calm, shaken = (bench.replay(r, replace(SCENARIO, thrust_noise=n)) for n in (0.0, 0.02))
    for axis in (0, 1):
        assert flight.authority(calm, axis).ratio > 0.75
        assert 0.35 < flight.authority(shaken, axis).ratio < 0.6


def test_the_command_compares_a_folder(
    bench: ModuleType,
    flight: ModuleType,
    flown: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "datasets" / "dataset"
    folder.mkdir(parents=True)
    write_nanobench(flight, flown, folder / "B2_circle_slow_rep1.csv")
    write_nanobench(flight, flown, folder / "B2_circle_slow_rep2.csv")  # a copy, that counts once
    write_nanobench(flight, circle(flight, duty=np.zeros((ROWS, 4))), folder / "B7_oval.csv")
    values = tmp_path / "values.json"
    words = [str(tmp_path), "--jobs", "1", "--json", str(values)]
    monkeypatch.setattr(sys, "argv", ["real_flights.py", *words])
    bench.main()
    said = capsys.readouterr().out
    assert "left out: B7_oval: the motors never ran" in said
    assert "NanoBench, 1 flights" in said
    assert "1/1 B2_circle_slow_rep1\n" in said
    for item in flight.ITEMS:
        assert item.name in said, item.name
    assert '"B2_circle_slow_rep1"' in values.read_text()


@pytest.mark.parametrize("folder", [".", "nowhere"])
def test_without_records_it_says_so_and_ends_with_2(
    bench: ModuleType,
    folder: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    monkeypatch.setattr(sys, "argv", ["real_flights.py", str(tmp_path / folder)])
    with pytest.raises(SystemExit) as end:
        bench.main()
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "docs/real-flights.md" in said
