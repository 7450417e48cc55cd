"""The implementation of `perchctl fleet fly`: processes, the operator, the display, and the
outcome."""

from __future__ import annotations

import contextlib
import json
import shlex
import string
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import display as displays
from perchctl import fleet as fleets
from perchctl import flight as flights
from perchctl.commands.interrupt import ignore_signals
from perchctl.commands.output import (
    ask_to_confirm,
    print_lines,
    print_result,
    say,
    stdin_number,
)
from perchctl.errors import EXIT_CODES, Interrupted, InvalidValue, PerchError, UsageError
from perchctl.extensions import error_at
from perchctl.files import write_files

DISPLAY_PERIOD_S = 0.1
"""Update period of display and record, s. Commands are sent at once."""
ENDING_TIMEOUT_S = 90.0
"""Time for vehicles to land and their processes to end after a failure of the parent, s. This time
is longer than it takes to land and then close the link and the log. Shorter: a process may be ended
while its vehicle is still flying. Longer: a failed command ends later."""
NUMBER_KEYS = 9
"""Number of vehicles that can be landed with a number key."""


@dataclass(frozen=True, kw_only=True)
class FleetSettings:
    """The options from the command line. `log_dir` and `record` are None if the user did not set
    them. `view`: serve a live page."""

    seed: int
    log_dir: Path | None
    record: bool | None
    yes: bool
    as_json: bool
    view: bool = False


def fly_fleet(plan: fleets.FleetPlan, settings: FleetSettings) -> int:
    """Fly a fleet according to its plan; return the exit code. Errors: any of `perchctl.errors`."""
    started, started_s = datetime.now(UTC), time.monotonic()
    folder = fleets.make_folder(_parent_folder(plan, settings), plan, started)
    options = fleets.flight_options(plan, folder, settings.seed, settings.record)
    for warning in fleets.warnings_before_fleet(options):
        say(f"check: {warning}")
    for sentence in plan.reassigned:
        say(f"assign: nearest: {sentence}")
    asks = not (settings.yes or all(each.simulated for each in options.values()))
    if asks and not sys.stdin.isatty():
        raise UsageError(
            f"about to arm {len(options)} vehicles, and the input is not a terminal: add --yes"
        )
    if settings.view:
        options = {name: replace(each, serve_pictures=True) for name, each in options.items()}
    with fleets.open_radios(plan) as radios:
        session = FleetSession(
            plan, radios.route(options), radios, folder, started, started_s, settings.view
        )
        try:
            outcome = session.fly(asks)
        finally:
            with contextlib.suppress(OSError):
                folder.rmdir()  # a flight that was refused on the ground leaves no files
    written = print_lines(outcome.text(), stdout=not settings.as_json)
    print_lines(f"{'folder':<12}{folder}", stdout=not settings.as_json)
    if settings.as_json:
        print_result(outcome.record() | {"folder": str(folder)})
    return outcome.exit_code or (0 if written else InvalidValue.exit_code)


def refuse_before_start(plan: fleets.FleetPlan, settings: FleetSettings) -> None:
    """If `fly_fleet` would refuse this plan, raise its error before anything is opened or
    started."""
    folder = _parent_folder(plan, settings) / plan.fleet.name
    options = fleets.flight_options(plan, folder, settings.seed, settings.record)
    fleets.warnings_before_fleet(options)


def _parent_folder(plan: fleets.FleetPlan, settings: FleetSettings) -> Path:
    return settings.log_dir or Path(plan.fleet.vehicles[0].profile.log.directory)


class FleetSession:
    """One flight of a fleet on this terminal."""

    def __init__(
        self,
        plan: fleets.FleetPlan,
        options: Mapping[str, flights.FlyOptions],
        radios: fleets.Radios,
        folder: Path,
        started: datetime,
        started_s: float,
        view: bool = False,
    ) -> None:
        self._plan, self._options, self._folder = plan, options, folder
        self._radios = radios
        self._started, self._started_s = started, started_s
        self._switch = flights.OperatorSwitch()
        self._children: dict[str, fleets.VehicleProcess] = {}
        self._panel: displays.FleetPanel | None = None
        self._has_page = view
        self._page: displays.FleetPage | None = None
        self._shown_round = 0
        self._told: dict[str, str] = {}
        self._radio_problems: dict[str, str] = {}
        self._problems: list[str] = []
        self._answers: deque[str] = deque()  # replies to key presses, from the keyboard thread
        self._slowed: set[str] = set()
        self._recorded = 0
        self._failed_s: float | None = None
        self._unwritten: str | None = None

    def fly(self, asks: bool) -> fleets.FleetOutcome:
        """Start all vehicles, wait until they are ready, ask for confirmation, and fly. If a
        vehicle fails before the first take-off, its error is raised."""
        with ignore_signals(), contextlib.ExitStack() as stack:
            stack.callback(self._close_panel)
            stack.enter_context(flights.operator_signals(self._switch, say))
            try:
                coordinator = stack.enter_context(self._coordinated())
                self._open_page(coordinator, stack)
                self._wait_until_ready(coordinator)
                if asks:
                    self._ask(coordinator)
                # The keys must work until all vehicles have ended, even after an error.
                self._fly(coordinator, stack)
                outcome = self._outcome(coordinator)
                self._end_page(_outcome_card(outcome, self._folder))
            except BaseException as error:
                self._end(error)
                why = str(error) or type(error).__name__
                self._end_page({"outcome": "FAILED", "good": False, "reason": why, "rows": []})
                raise
        return outcome

    @contextlib.contextmanager
    def _coordinated(self) -> Iterator[fleets.Coordinator]:
        """Start the vehicles' processes and the thread that coordinates them."""
        over = threading.Event()
        with contextlib.ExitStack() as stack:
            for name, each in self._options.items():
                child = self._children[name] = fleets.VehicleProcess(name, each)
                stack.callback(child.close)
            names = ", ".join(self._options)
            say(f"connecting to {len(self._options)} vehicles: {names}")
            coordinator = fleets.Coordinator(self._plan, self._children, self._switch)
            thread = threading.Thread(
                target=coordinator.run, args=(over,), name="fleet", daemon=True
            )
            thread.start()
            stack.callback(thread.join, 1.0)
            stack.callback(over.set)
            yield coordinator

    def _open_page(self, coordinator: fleets.Coordinator, stack: contextlib.ExitStack) -> None:
        """Serve the live page until the stack closes. A failing page does not end the flight."""
        if not self._has_page:
            return

        def land_one(number: int) -> None:
            self._answers.append(self._land_one(coordinator, number, "button"))

        try:
            name, switch = self._plan.fleet.name, self._switch
            page = displays.FleetPage(
                f"perchctl fleet fly {name}", len(self._options), switch.land, switch.cut, land_one
            )
        except Exception as error:
            say(f"the live page failed: {error_at(error)}")
            return
        stack.callback(page.close)
        self._page = page
        say(f"live page (with buttons to land and to cut the motors): {page.url}")

    def _update_page(self, update: Callable[[displays.FleetPage], None]) -> None:
        """Update the page. After an error, the page is no longer updated; its buttons still work,
        and it shows the age of its values."""
        if self._page is None:
            return
        try:
            update(self._page)
        except Exception as error:
            self._page = None
            say(f"the live page failed: {error_at(error)}")

    def _end_page(self, card: dict[str, Any]) -> None:
        page = self._page
        self._update_page(lambda page: page.end(card))
        if page is not None and page.problem is not None:
            self._tell(f"the live page failed: {page.problem}")

    def _wait_until_ready(self, coordinator: fleets.Coordinator) -> None:
        while not coordinator.are_ready:
            self._look(coordinator)
            self._refuse_failed(coordinator)
            time.sleep(DISPLAY_PERIOD_S)
        self._look(coordinator)
        self._refuse_failed(coordinator)

    def _refuse_failed(self, coordinator: fleets.Coordinator) -> None:
        """Raise the error that kept the fleet on the ground: the coordinator's, or a vehicle's once
        all vehicles have ended."""
        results = {v.name: v.result for v in coordinator.views if v.result is not None}
        failure = coordinator.failure
        if coordinator.started:  # read last, because `started` can become True at any time
            return
        if failure is not None:
            raise PerchError(f"{_failure_text(failure)}; no vehicle was armed")
        if len(results) == len(self._options):
            name = fleets.worst_of(results)
            error = fleets.as_error(name, results[name])
            raise type(error)(f"{error}; no vehicle was armed")

    def _ask(self, coordinator: fleets.Coordinator) -> None:
        names = ", ".join(self._options)
        question = f"About to arm and fly {len(self._options)} vehicles: {names}. "
        if not ask_to_confirm(f"{question}Is the space under the targets clear?"):
            raise UsageError("not confirmed: nothing was started")

    def _fly(self, coordinator: fleets.Coordinator, stack: contextlib.ExitStack) -> None:
        def on_keys(keys: bytes) -> None:
            for key in keys:
                if (digit := chr(key)) in string.digits:
                    self._answers.append(self._land_by_key(coordinator, int(digit)))

        self._switch.listening = True
        has_keys = stack.enter_context(flights.cut_key(self._switch, stdin_number(), on_keys))
        one = f"Press {self._keys_text} to land {'it' if self._keys == 1 else 'one vehicle'}."
        help_lines = flights.STOP_HELP, f"{flights.KEY_HELP} {one}" if has_keys else ""
        print_lines("\n".join(filter(None, help_lines)))
        self._panel = displays.FleetPanel(sys.stderr, help_lines)
        coordinator.confirm()
        while not (coordinator.has_ended or self._is_given_up()):
            self._look(coordinator)
            self._refuse_failed(coordinator)
            time.sleep(DISPLAY_PERIOD_S)
        self._look(coordinator)
        self._refuse_failed(coordinator)
        if coordinator.started:
            self._write_record(coordinator)

    @property
    def _keys(self) -> int:
        """The number of vehicles that can be landed by a key."""
        return min(len(self._options), NUMBER_KEYS)

    @property
    def _keys_text(self) -> str:
        return {1: "1", 2: "1 or 2"}.get(self._keys, f"a key from 1 to {self._keys}")

    def _land_by_key(self, coordinator: fleets.Coordinator, number: int) -> str:
        """Land the vehicle with this number at once; return the reply to the operator. Called in
        the keyboard thread, which must not be blocked."""
        if not 1 <= number <= self._keys:
            return f"no vehicle is assigned to key {number}: press {self._keys_text} to land one"
        return self._land_one(coordinator, number, f"key {number}")

    def _land_one(self, coordinator: fleets.Coordinator, number: int, how: str) -> str:
        """Land the vehicle with this number at once; return the reply. May be called from any
        thread."""
        view = coordinator.views[number - 1]
        coordinator.land(view.name)
        if view.result is not None:
            return f"{view.name}: its flight has already ended"
        if view.stage.is_before_takeoff:
            return f"{view.name}: take-off cancelled ({how})"
        return f"{view.name}: landing ({how})"

    def _is_given_up(self) -> bool:
        """True if the coordinator has failed, and the vehicles have not ended within the time
        allowed."""
        now_s = time.monotonic()
        return self._failed_s is not None and now_s - self._failed_s > ENDING_TIMEOUT_S

    def _look(self, coordinator: fleets.Coordinator) -> None:
        """Report what has changed, and update displays and record. An exception in one of these
        parts is reported once; it neither ends a flight nor stops the other parts."""
        parts = (
            self._look_at_coordinator,
            self._answer_keys,
            self._look_at_stages,
            self._look_at_radios,
            self._look_at_distances,
            self._show_rows,
            self._show_page,
            self._keep_record,
        )
        for part in parts:
            try:
                part(coordinator)
            except Exception as error:
                self._report(f"the display failed: {error_at(error)}: the flights continue")

    def _look_at_coordinator(self, coordinator: fleets.Coordinator) -> None:
        if coordinator.failure is not None and coordinator.started and self._failed_s is None:
            self._failed_s = time.monotonic()
            self._report(f"{_failure_text(coordinator.failure)}: all vehicles land")

    def _answer_keys(self, _: fleets.Coordinator) -> None:
        while self._answers:
            self._tell(self._answers.popleft())

    def _look_at_stages(self, coordinator: fleets.Coordinator) -> None:
        """Report each vehicle's new stage or phase, and how its flight ended."""
        for view in coordinator.views:
            stage, reason = _stage_and_reason(view)
            # If the fleet never takes off, the reason is reported in one sentence at the end.
            is_told = coordinator.started or view.result is None
            if is_told and stage != self._told.get(view.name, fleets.Stage.STARTING.value):
                self._tell(f"{view.name}: {stage}: {reason}".rstrip(": "))
            self._told[view.name] = stage

    def _look_at_radios(self, coordinator: fleets.Coordinator) -> None:
        """Give the radio time of vehicles whose flights have ended to the others. Report dongles
        that have failed or recovered."""
        for view in coordinator.views:
            if view.result is not None and view.name not in self._slowed:
                self._slowed.add(view.name)
                self._radios.slow_down(self._options[view.name].uri)
        before, self._radio_problems = self._radio_problems, self._radios.problems()
        for dongle in before.keys() - self._radio_problems.keys():
            self._tell(f"dongle {dongle} works again")
        for dongle, problem in self._radio_problems.items():
            if dongle not in before:
                self._problems.append(f"dongle {dongle}: {problem}")
                self._tell(self._problems[-1])

    def _look_at_distances(self, coordinator: fleets.Coordinator) -> None:
        """Report, once each, every pair of vehicles that came too close, and every vehicle whose
        distance to the others became unknown."""
        near = [f"{pair}: both land" for pair in coordinator.near_pairs]
        unknown = [
            f"{name}: its position is unknown, and so is its distance to the others"
            for name in coordinator.unwatched
        ]
        for problem in (*near, *unknown):
            self._report(problem)

    def _show_rows(self, coordinator: fleets.Coordinator) -> None:
        if self._panel is not None:
            views = enumerate(coordinator.views, 1)
            self._panel.show([_row(number, view) for number, view in views])

    def _show_page(self, coordinator: fleets.Coordinator) -> None:
        """Show the coordinator's newest data on the page. If the coordinator stops responding, the
        page shows how old the data is."""
        if self._page is not None and coordinator.rounds != self._shown_round:
            self._shown_round = coordinator.rounds
            rows = [_row(number, view) for number, view in enumerate(coordinator.views, 1)]
            self._update_page(lambda page: page.show(rows, live=coordinator.started))

    def _keep_record(self, coordinator: fleets.Coordinator) -> None:
        """Update the record file if another vehicle's flight has ended."""
        ended = sum(view.result is not None for view in coordinator.views)
        if coordinator.started and ended > self._recorded:
            self._recorded = ended
            self._write_record(coordinator)

    def _report(self, problem: str) -> None:
        """Report a problem and add it to the record, unless that was already done."""
        if problem not in self._problems:
            self._problems.append(problem)
            self._tell(problem)

    def _tell(self, line: str) -> None:
        at = f"[{time.monotonic() - self._started_s:7.2f} s] {line}"
        self._update_page(lambda page: page.event(at))
        if self._panel is not None and self._panel.failure is not None:
            say(self._panel.failure)
            self._panel.close()
            self._panel = None
        if self._panel is None:
            say(line)
        else:
            self._panel.event(at)

    def _write_record(self, coordinator: fleets.Coordinator) -> None:
        """Write the record so far. An error such as a full disk does not land the vehicles."""
        try:
            record = json.dumps(self._outcome(coordinator).record(), indent=1)
            write_files({self._folder / fleets.RECORD_NAME: f"{record}\n".encode()})
            self._unwritten = None
        except (OSError, PerchError) as error:
            self._unwritten = f"{fleets.RECORD_NAME} cannot be written: {error}"
        except Exception as error:
            self._unwritten = f"{fleets.RECORD_NAME} cannot be written: {error_at(error)}"

    def _outcome(self, coordinator: fleets.Coordinator) -> fleets.FleetOutcome:
        return fleets.FleetOutcome(
            plan=self._plan,
            options=self._options,
            started=self._started,
            started_s=self._started_s,
            results={v.name: v.result for v in coordinator.views if v.result is not None},
            problems=tuple(self._problems),
            failed=coordinator.failure is not None,
        )

    def _end(self, error: BaseException) -> None:
        """Land all flying vehicles, and wait until their processes have ended. After an emergency
        stop by the operator, do not wait for processes that do not respond."""
        self._switch.land()
        hung = isinstance(error, Interrupted) and self._switch.listening
        if self._panel is not None and not (hung or all(map(_has_ended, self._children.values()))):
            self._tell(f"the command failed ({error_at(error)}): all vehicles land")
        end_s = time.monotonic() + (0.0 if hung else ENDING_TIMEOUT_S)
        while time.monotonic() < end_s and not all(map(_has_ended, self._children.values())):
            time.sleep(DISPLAY_PERIOD_S)

    def _close_panel(self) -> None:
        if self._panel is not None:
            self._panel.close()
            if self._panel.failure is not None:
                say(self._panel.failure)
        if self._unwritten is not None:
            say(self._unwritten)


def _failure_text(failure: str) -> str:
    return f"the fleet's coordinator failed ({failure})"


def _has_ended(child: fleets.VehicleProcess) -> bool:
    return child.result() is not None or child.end_of_process() is not None


def _stage_and_reason(view: fleets.VehicleView) -> tuple[str, str]:
    result, status = view.result, view.status
    if result is not None:
        return ("hangs" if result.hangs else result.outcome.value), result.reason
    if status is None:
        return fleets.Stage.STARTING.value, ""
    return (status.phase or status.stage).value, status.reason


def _row(number: int, view: fleets.VehicleView) -> displays.FleetRow:
    phase, reason = _stage_and_reason(view)
    status = view.status
    silent = view.result is None and view.is_silent
    ended, hangs = view.result is not None, view.result is not None and view.result.hangs
    if status is None:
        return displays.FleetRow(
            number=number,
            name=view.name,
            phase=phase,
            reason=reason,
            has_ended=ended,
            is_silent=silent,
        )
    return displays.FleetRow(
        number=number,
        name=view.name,
        phase=phase,
        reason=f"its process has been silent for {view.silent_s:.0f} s" if silent else reason,
        height_m=status.height_m,
        error_m=status.error_m,
        battery_v=status.battery_v,
        link_s=status.telemetry_age_s,
        has_ended=ended,
        hangs=hangs,
        is_silent=silent,
        picture_port=None if ended else status.picture_port,
    )


def _outcome_card(outcome: fleets.FleetOutcome, folder: Path) -> dict[str, Any]:
    """The card with the result that the page shows at the end."""
    count, code = len(outcome.options), outcome.exit_code
    reason = "all vehicles hang" if code == 0 else f"exit code {code}: {EXIT_CODES[code]}"
    place = str(folder.resolve())
    return {
        "outcome": f"{outcome.hanging} OF {count} HANG",
        "good": code == 0,
        "reason": reason,
        "rows": [
            *(["problem", problem] for problem in outcome.problems),
            ["folder", place],
            ["report", f"perchctl log report {shlex.quote(place)}"],
        ],
    }
