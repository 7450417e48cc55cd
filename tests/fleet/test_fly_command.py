"""`perchctl fleet fly`: what it refuses before it starts, and whole flights in real time."""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl import fleet as fleets
from perchctl.calibration import profile_camera
from perchctl.commands import fly_fleet
from perchctl.commands.fly_fleet import FleetSession
from perchctl.display import FleetPage, FleetPanel
from perchctl.display.fleet_panel import FleetRow, fleet_table
from perchctl.errors import NotFound, PerchError
from perchctl.fleet import (
    Coordinator,
    FleetOutcome,
    FleetPlan,
    Radios,
    VehicleView,
    coordinator,
    flight_options,
    load_fleet,
    make_plan,
    prepare,
)
from perchctl.fleet.messages import Order, Result, Stage, Status, VehicleOutcome
from perchctl.flight import FlyOptions, OperatorSwitch
from perchctl.mission import OperatorRequest, Phase
from perchctl.profile import load_profile
from perchctl.record import read_log
from perchctl.sim import SimProcess, draw_scenario
from tests.helpers.commands import run, run_apart
from tests.helpers.dongle import uris
from tests.helpers.live_page import press

TWO = """\
name: two
defaults: {profile: sim, uri: "sim://", source: "sim:"}
order: together
vehicles:
  - {name: north, home_m: [0, 0], target_m: [0.2, 0.1]}
  - {name: east, home_m: [2.6, 0], target_m: [2.8, 0]URI}
"""


def two(folder: Path, more: str = "") -> Path:
    path = folder / "two.yaml"
    path.write_text(TWO.replace("URI", more), encoding="utf-8")
    return path


def test_a_dry_run_shows_the_plan_and_starts_nothing(tmp_path: Path) -> None:
    done = run("fleet", "fly", "--dry-run", "--log-dir", str(tmp_path / "logs"))
    assert done.code == 0
    assert "group 1: north, east" in done.stdout
    assert not (tmp_path / "logs").exists()


def on_one_dongle(folder: Path, uris: Sequence[str], sources: Sequence[str]) -> Path:
    """The same two as real vehicles."""
    path = two(folder, f", uri: '{uris[1]}', source: '{sources[1]}'")
    north = f"name: north, uri: '{uris[0]}', source: '{sources[0]}'"
    path.write_text(path.read_text().replace("name: north", north), encoding="utf-8")
    return path


@pytest.mark.parametrize(("extra", "code"), [((), 2), (("--dry-run",), 0)])
def test_no_dongle_is_opened_before_all_else_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extra: tuple[str, ...], code: int
) -> None:
    opened: list[object] = []
    monkeypatch.setattr(prepare, "RadioHub", opened.append)
    air = on_one_dongle(tmp_path, uris(2), ("camera:0", "camera:1"))
    done = run("fleet", "fly", str(air), *extra)
    assert (done.code, opened) == (code, []), done.stderr


def test_a_dead_dongle_and_its_return_are_told_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problems: dict[str, str] = {}
    plan = make_plan(load_fleet())
    radios: Any = SimpleNamespace(problems=lambda: dict(problems))
    session = FleetSession(plan, {}, radios, tmp_path, datetime.now(UTC), 0.0)
    nobody: Any = SimpleNamespace(
        views=(), started=False, near_pairs=(), unwatched=(), failure=None
    )
    session._look(nobody)
    problems["0"] = "the radio hub has not reported for 1.1 s"
    session._look(nobody)
    problems["0"] = "the radio hub has not reported for 1.2 s"
    session._look(nobody)
    problems.clear()
    session._look(nobody)
    session._look(nobody)
    assert capsys.readouterr().err.splitlines() == [
        "perchctl: dongle 0: the radio hub has not reported for 1.1 s",
        "perchctl: dongle 0 works again",
    ]
    assert len(session._outcome(nobody).record()["problems"]) == 1


PERCHED = Result(
    exit_code=0, outcome=VehicleOutcome.PERCHED, reason="hanging still", has_flown=True
)


class FakeProcess:
    """A vehicle's process that is ready at once, flies once it may, and lands when ordered to.

    With `END` it ends so after 0.7 s in the air."""

    END: Result | None = None

    def __init__(self, name: str, options: FlyOptions) -> None:
        self._status = Status(stage=Stage.READY)
        self._result: Result | None = None
        self.orders: list[Order] = []

    def send(self, order: Order) -> None:
        self.orders.append(order)
        if order.may_take_off:
            self._status = Status(stage=Stage.FLYING, phase=Phase.ALIGN)
            if sum(order.may_take_off for order in self.orders) > 7:
                self._result = self.END
        elif order.word is not OperatorRequest.NONE and self._result is None:
            self._result = Result(
                exit_code=130,
                outcome=VehicleOutcome.LANDED,
                reason="operator",
                has_flown=self._status.stage is Stage.FLYING,
            )

    def newest(self) -> tuple[Status | None, float]:
        return self._status, time.monotonic()

    def result(self) -> Result | None:
        return self._result

    def fault(self) -> str | None:
        return None

    def end_of_process(self) -> str | None:
        return None

    def kill(self) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FleetSession:
    """A session with fake processes, without a terminal."""
    monkeypatch.setattr(fleets, "VehicleProcess", FakeProcess, raising=False)
    plan = make_plan(load_fleet())
    options = flight_options(plan, tmp_path, 0, None)
    return FleetSession(plan, options, Radios({}), tmp_path, datetime.now(UTC), time.monotonic())


def test_a_coordinator_that_fails_in_flight_lands_all_and_is_reported(
    session: FleetSession,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def find_near_pairs(plan: FleetPlan, views: Sequence[VehicleView]) -> tuple[()]:
        if any(view.is_in_air for view in views):
            raise RuntimeError("nobody foresaw this")
        return ()

    monkeypatch.setattr(coordinator, "find_near_pairs", find_near_pairs)
    outcome = session.fly(asks=False)
    assert [each.outcome for each in outcome.results.values()] == [VehicleOutcome.LANDED] * 4
    assert outcome.exit_code == 1
    problem = "the fleet's coordinator failed (RuntimeError: nobody foresaw this"
    assert outcome.problems[0].startswith(problem)
    assert outcome.problems[0].endswith("all vehicles land")
    assert f"{problem}" in capsys.readouterr().err
    record = json.loads((tmp_path / "fleet.json").read_text())
    assert (record["exit_code"], record["unfinished"]) == (1, [])


def test_a_display_that_fails_is_reported_once_and_ends_no_flight(
    session: FleetSession,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("nobody foresaw this")

    monkeypatch.setattr(session._radios, "problems", fail)
    monkeypatch.setattr(FakeProcess, "END", PERCHED)
    outcome = session.fly(asks=False)
    assert [each.outcome for each in outcome.results.values()] == [VehicleOutcome.PERCHED] * 4
    assert outcome.exit_code == 0
    assert len(outcome.problems) == 1
    assert outcome.problems[0].startswith("the display failed: RuntimeError: nobody foresaw this")
    assert capsys.readouterr().err.count("nobody foresaw this") == 1
    assert json.loads((tmp_path / "fleet.json").read_text())["hanging"] == 4


def test_an_error_of_the_command_in_flight_lands_all_and_is_told_at_once(
    session: FleetSession, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(coordinator: Coordinator) -> None:
        if any(view.is_in_air for view in coordinator.views):
            raise RuntimeError("nobody foresaw this")

    monkeypatch.setattr(session, "_refuse_failed", refuse)
    with pytest.raises(RuntimeError, match="nobody foresaw this"):
        session.fly(asks=False)
    processes: Any = session._children.values()
    assert all(each.result().outcome is VehicleOutcome.LANDED for each in processes)
    said = capsys.readouterr().err
    assert "the command failed (RuntimeError: nobody foresaw this" in said
    assert "all vehicles land" in said


def test_a_record_that_cannot_be_made_ends_no_flight(
    session: FleetSession, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: object) -> None:
        raise RuntimeError("nobody foresaw this")

    monkeypatch.setattr(FleetOutcome, "record", fail)
    monkeypatch.setattr(FakeProcess, "END", PERCHED)
    assert session.fly(asks=False).exit_code == 0
    assert "fleet.json cannot be written: RuntimeError: nobody" in capsys.readouterr().err


def test_events_are_still_told_once_the_panel_has_failed(
    session: FleetSession, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(panel: FleetPanel) -> None:
        raise RuntimeError("no room on the screen")

    monkeypatch.setattr(FleetPanel, "_draw_once", fail)
    monkeypatch.setattr(FakeProcess, "END", PERCHED)
    session.fly(asks=False)
    said = capsys.readouterr().err
    assert said.count("the display failed: RuntimeError: no room on the screen") == 1
    assert "west: hangs: hanging still" in said


def test_each_number_key_is_answered(
    session: FleetSession, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @contextlib.contextmanager
    def keys(
        switch: OperatorSwitch, terminal: int, on_keys: Callable[[bytes], None]
    ) -> Iterator[bool]:
        def press(coordinator: Coordinator) -> None:
            if coordinator.started and not pressed:
                pressed.append(b"0x41\x00\xb2")
                on_keys(pressed[0])

        monkeypatch.setattr(session, "_show_rows", press)
        yield True

    pressed: list[bytes] = []
    monkeypatch.setattr("perchctl.flight.cut_key", keys)
    monkeypatch.setattr(FakeProcess, "END", PERCHED)
    outcome = session.fly(asks=False)
    ends = [each.outcome.value for each in outcome.results.values()]
    assert ends == ["landed", "perched", "perched", "landed"]
    said = [re.sub(r"^\[.*\] ", "", line) for line in capsys.readouterr().err.splitlines()]
    assert [line for line in said if "key" in line and "cuts" not in line] == [
        "no vehicle is assigned to key 0: press a key from 1 to 4 to land one",
        "west: take-off cancelled (key 4)",
        "north: landing (key 1)",
    ]


def test_a_number_key_is_answered_by_what_it_does(session: FleetSession) -> None:
    flying = Status(stage=Stage.FLYING, phase=Phase.ALIGN)
    views = (
        VehicleView(name="north", status=flying),
        VehicleView(name="east", status=flying, result=PERCHED),
    )
    landed: list[str] = []
    fleet: Any = SimpleNamespace(views=views, land=landed.append)
    assert session._land_by_key(fleet, 1) == "north: landing (key 1)"
    assert session._land_by_key(fleet, 2) == "east: its flight has already ended"
    assert landed == ["north", "east"]


# --- The live page ---


@pytest.fixture
def viewed(session: FleetSession) -> FleetSession:
    """The session with a live page."""
    session._has_page = True
    return session


def once_started(session: FleetSession, act: Callable[[FleetPage], None]) -> None:
    """Act once the first vehicle is in the air, as somebody at the page would."""
    acted: list[None] = []

    def look(coordinator: Coordinator) -> None:
        if any(view.is_in_air for view in coordinator.views) and not acted:
            acted.append(None)
            assert session._page is not None
            act(session._page)

    session._show_rows = look  # type: ignore[method-assign]


def test_stop_all_on_the_page_lands_all(
    viewed: FleetSession, capsys: pytest.CaptureFixture[str]
) -> None:
    once_started(viewed, lambda page: press(page.url, page.token, "land"))  # type: ignore[arg-type]
    outcome = viewed.fly(asks=False)
    assert [each.outcome for each in outcome.results.values()] == [VehicleOutcome.LANDED] * 4
    assert "live page (with buttons to land and to cut the motors): http://127.0.0.1:" in (
        capsys.readouterr().err
    )


def test_stop_all_also_counts_while_the_operator_is_being_asked(
    viewed: FleetSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A late yes on the terminal does not undo it."""

    def say_yes(_: str) -> bool:
        assert viewed._page is not None
        assert press(viewed._page.url, viewed._page.token, "land") == 200
        return True

    monkeypatch.setattr(fly_fleet, "ask_to_confirm", say_yes)
    with pytest.raises(PerchError, match="no vehicle was armed"):
        viewed.fly(asks=True)
    processes: Any = viewed._children.values()
    assert not any(order.may_take_off for each in processes for order in each.orders)


def test_a_tiles_button_lands_its_vehicle_alone(
    viewed: FleetSession, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    once_started(viewed, lambda page: press(page.url, page.token, "land/4"))  # type: ignore[arg-type]
    monkeypatch.setattr(FakeProcess, "END", PERCHED)
    outcome = viewed.fly(asks=False)
    ends = {name: each.outcome.value for name, each in outcome.results.items()}
    assert ends.pop("west") == "landed"
    assert {*ends.values()} == {"perched"}
    assert "west: take-off cancelled (button)" in capsys.readouterr().err


def test_the_page_shows_the_flight_and_how_it_ended(
    viewed: FleetSession, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ends: list[dict[str, Any]] = []
    monkeypatch.setattr(FleetPage, "close", lambda page: ends.append(page.state()))
    monkeypatch.setattr(FakeProcess, "END", PERCHED)
    viewed.fly(asks=False)
    (state,) = ends
    assert [vehicle["phase"] for vehicle in state["vehicles"]] == ["hangs"] * 4
    assert any(line.endswith("north: ALIGN") for line in state["events"])
    card = state["card"]
    assert (card["outcome"], card["good"]) == ("4 OF 4 HANG", True)
    assert card["rows"][-1] == ["report", f"perchctl log report {tmp_path}"]


@pytest.mark.parametrize("part", ["__init__", "show", "event", "end"])
def test_a_page_that_fails_ends_no_flight(
    viewed: FleetSession,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    part: str,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("nobody foresaw this")

    monkeypatch.setattr(FleetPage, part, fail)
    monkeypatch.setattr(FakeProcess, "END", PERCHED)
    outcome = viewed.fly(asks=False)
    assert [each.outcome for each in outcome.results.values()] == [VehicleOutcome.PERCHED] * 4
    assert "nobody foresaw this" in capsys.readouterr().err


def test_the_page_shows_nothing_new_while_the_coordinator_hangs(viewed: FleetSession) -> None:
    shown: list[object] = []
    page: Any = SimpleNamespace(show=lambda rows, live: shown.append(rows))
    viewed._page = page
    hung: Any = SimpleNamespace(views=(), started=True, rounds=7)
    viewed._show_page(hung)
    viewed._show_page(hung)
    assert len(shown) == 1
    hung.rounds += 1
    viewed._show_page(hung)
    assert len(shown) == 2


def test_a_coordinator_that_fails_on_the_ground_is_an_error_and_nothing_is_armed(
    session: FleetSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    def find_near_pairs(plan: FleetPlan, views: Sequence[VehicleView]) -> tuple[()]:
        raise RuntimeError("nobody foresaw this")

    monkeypatch.setattr(coordinator, "find_near_pairs", find_near_pairs)
    with pytest.raises(PerchError, match=r"coordinator failed .* no vehicle was armed"):
        session.fly(asks=True)
    processes: Any = session._children.values()
    assert not any(order.may_take_off for each in processes for order in each.orders)


def test_nobody_to_ask_is_no_yes(tmp_path: Path) -> None:
    air = two(tmp_path, ", uri: 'udp://127.0.0.1:9', source: 'http://127.0.0.1:9/'")
    done = run("fleet", "fly", str(air))
    assert done.code == 2
    assert "about to arm 2 vehicles, and the input is not a terminal: add --yes" in done.stderr


def test_the_panel_has_a_line_for_each_in_80_columns() -> None:
    from rich.console import Console

    rows = [
        FleetRow(
            number=number,
            name=f"vehicle-{number}",
            phase="ESTIMATE",
            reason="steady again, trying once more, and a reason that is longer than the panel",
            height_m=12.34,
            error_m=1.234,
            battery_v=3.78,
            link_s=9.99,
        )
        for number in range(1, 33)
    ]
    console = Console(width=80)
    with console.capture() as captured:
        console.print(fleet_table(rows, "below", "above"))
    lines = captured.get().splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) == len(rows) + 3
    shown = lines[3]
    assert all(part in shown for part in ("vehicle-2", "ESTIMATE", "12.34 m", "123.4 cm", "3.78 V"))


@pytest.mark.long
def test_one_that_does_not_answer_and_nothing_arms(tmp_path: Path) -> None:
    """Its camera does not either, and is asked first."""
    bad = two(tmp_path, ", uri: 'udp://127.0.0.1:9', source: 'http://127.0.0.1:9/'")
    done = run_apart("fleet", "fly", str(bad), "--yes", "--log-dir", str(tmp_path / "logs"))
    sentence = done.stderr.splitlines()[-1]
    assert done.code == NotFound.exit_code, done.stderr
    assert sentence.startswith("perchctl: east: http://127.0.0.1:9/ delivered no picture")
    assert sentence.endswith("no vehicle was armed")
    assert "APPROACH" not in done.stderr
    assert not list(tmp_path.glob("logs/*"))


@pytest.mark.long
def test_four_vehicles_fly_in_real_time(tmp_path: Path) -> None:
    """The shipped fleet, as a newcomer flies it. What hangs is asserted for most of them: on a
    computer that is busy with other tests, a vehicle may land."""
    done = run_apart("fleet", "fly", "--json", "--log-dir", str(tmp_path), timeout_s=240.0)
    record = json.loads(done.stdout)
    folder = Path(record["folder"])
    assert record["hanging"] >= 3, done.stderr
    assert (done.code == 0) == (record["hanging"] == 4)
    assert json.loads((folder / "fleet.json").read_text())["vehicles"] == record["vehicles"]
    for vehicle in record["vehicles"]:
        assert read_log(folder / vehicle["log"]).header["seed"] == vehicle["seed"]
    south = record["vehicles"][2]
    assert all(v["ended_s"] < south["ended_s"] for v in record["vehicles"][:2])


@pytest.mark.long
def test_two_that_come_too_near_land_and_say_how_near(tmp_path: Path) -> None:
    """Under a parent that calls 2.6 m too near."""
    pytest.importorskip("motioncapture", reason="needs the extra [mocap]")
    path = two(tmp_path)
    capture = "profile: sim, positioning: {by: mocap}"
    path.write_text(path.read_text().replace("profile: sim", capture), encoding="utf-8")
    done = run_apart(
        *("fleet", "fly", str(path), "--json", "--log-dir", str(tmp_path)),
        before="from perchctl.fleet import dispatch; dispatch.NEAR_MARGIN_M = -3.0",
        timeout_s=120.0,
    )
    record = json.loads(done.stdout)
    assert done.code == 52, done.stderr
    for vehicle, other in zip(record["vehicles"], ("east", "north"), strict=True):
        assert (vehicle["outcome"], vehicle["exit_code"]) == ("landed", 52), done.stderr
        assert re.match(rf"2\.\d\d m from {other} in the air: ", vehicle["reason"])
    assert re.fullmatch(
        r"north and east were 2\.\d\d m apart in the air: both land", record["problems"][0]
    )


HUB = """
from types import SimpleNamespace
from tests.helpers.dongle import OnLoopback, UsbPort, attach
port = UsbPort({uri: OnLoopback(at) for uri, at in VEHICLES.items()}, scale=0.5)
attach(port, SimpleNamespace(setattr=setattr))
from perchctl.link.sharing import serve_parent
serve_parent()
"""


@pytest.mark.long
def test_two_fly_over_one_dongle(tmp_path: Path) -> None:
    """Two simulated vehicles behind a fake dongle, flown as real ones: by the clock on the wall,
    through a hub in a process of its own.

    A computer that is too busy delivers images and telemetry late, and then a vehicle is right to
    land: what each ends with depends on the computer, that it ends on the ground or on its target
    does not."""
    profile, air = load_profile("sim"), uris(2)
    with contextlib.ExitStack() as stack:
        vehicles = [
            stack.enter_context(
                SimProcess.start(
                    replace(draw_scenario(profile, seed), target_xy_m=target_m),
                    camera=profile_camera(profile.camera),
                    target=profile.target,
                )
            )
            for seed, target_m in enumerate([(0.2, 0.1), (0.2, 0.0)], 11)
        ]
        path = on_one_dongle(tmp_path, air, [each.stream_url for each in vehicles])
        # Few packets, as a computer that is busy with other tests carries them late.
        slow = "profile: sim, link: {telemetry_period_s: 0.04}"
        path.write_text(path.read_text().replace("profile: sim", slow), encoding="utf-8")
        at = {uri: each.uri for uri, each in zip(air, vehicles, strict=True)}
        program = HUB.replace("VEHICLES", repr(at))
        done = run_apart(
            *("fleet", "fly", str(path), "--yes", "--json", "--no-record"),
            *("--log-dir", str(tmp_path / "logs")),
            before=f"from perchctl.link import hub; hub.PROGRAM = {program!r}",
            timeout_s=240.0,
        )
    record = json.loads(done.stdout)
    assert all(vehicle["has_flown"] for vehicle in record["vehicles"]), done.stderr
    assert record["problems"] == []
    for vehicle, uri in zip(record["vehicles"], air, strict=True):
        assert vehicle["outcome"] != "failed", done.stderr
        assert read_log(Path(record["folder"]) / vehicle["log"]).header["uri"] == uri
