"""The sender: what waits for the library, what is dropped, and a library that hangs or fails.

A library that hangs is one that waits for an event of the test's; how long it hangs is told by the
test's own clock.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

from perchctl.link.sender import (
    GUARD_PERIOD_S,
    LIBRARY_HANG_S,
    NOTED_EVERY_S,
    STALE_COMMAND_S,
    Sender,
)
from perchctl.mission import SentCommand
from perchctl.vehicle import Arm, Command, EmergencyStop, Land, PositionSetpoint, StopMotors
from tests.helpers.waiting import until

LIMIT_S = 5.0
LAND, STOP = Land(-0.05, 2.0), EmergencyStop()
PLACES = [PositionSetpoint(float(i), 0.0, 1.0, 0.0) for i in range(4)]


class Library:
    """`taken` is what it has; without `room` it takes nothing, `hanging` it does not return."""

    def __init__(self) -> None:
        self.taken: list[Any] = []
        self.offered = 0
        self.room = True
        self.error: BaseException | None = None
        self.called, self.free = threading.Event(), threading.Event()
        self.free.set()
        self.now_s = 10.0
        self.senders: list[Sender] = []

    def sender(self, **how: Any) -> Sender:
        """A sender that hands over to this library."""
        self.senders.append(Sender(self.hand_over, clock=lambda: self.now_s, **how))
        return self.senders[-1]

    def takes(self, *pieces: Any) -> None:
        """All that waits is taken, and these pieces are all that it has taken since."""
        assert self.senders[-1].drain(LIMIT_S)
        assert self.taken == list(pieces)
        self.taken.clear()

    def hand_over(self, piece: Any) -> bool:
        self.offered += 1
        self.called.set()
        if self.error is not None:
            raise self.error
        assert self.free.wait(LIMIT_S)
        if self.room:
            self.taken.append(piece)
        return self.room

    def hang_with(self, command: Command) -> None:
        """It does not return from the call with this command."""
        self.called.clear()
        self.free.clear()
        self.senders[-1].put(command)
        assert self.called.wait(LIMIT_S)


@pytest.fixture
def library() -> Iterator[Library]:
    library = Library()
    yield library
    library.free.set()
    for sender in library.senders:
        sender.stop()


# --- What waits -------------------------------------------------------------------------------


def test_orders_keep_their_place_and_of_setpoints_the_newest_counts(library: Library) -> None:
    sender = library.sender()
    library.hang_with(PLACES[0])
    for command in (PLACES[1], PLACES[2], StopMotors(), PLACES[3]):
        sender.put(command)
    assert sender.stuck_s() == 0.0
    library.now_s += 0.2
    assert sender.stuck_s() == pytest.approx(0.2)
    library.free.set()
    library.takes(PLACES[0], StopMotors(), PLACES[3])
    assert sender.stuck_s() == 0.0


def test_a_setpoint_that_waited_too_long_is_dropped_an_order_is_not(library: Library) -> None:
    library.room = False
    sender = library.sender()
    sender.put(LAND)
    sender.put(PLACES[0])
    library.now_s += 100.0
    assert STALE_COMMAND_S < 100.0
    library.room = True
    library.takes(LAND)


def test_an_order_that_waits_is_replaced_by_its_like_and_all_by_a_stop(library: Library) -> None:
    library.room = False
    sender = library.sender()
    newer = Land(-0.05, 3.0)
    for command in (StopMotors(), LAND, newer):
        sender.put(command)
    library.room = True
    library.takes(StopMotors(), newer)
    library.room = False
    for command in (LAND, StopMotors(), STOP, STOP):
        sender.put(command)
    library.room = True
    library.takes(STOP)


def thirds(command: Command) -> list[Any]:
    return [(command, part) for part in range(3)]


def test_without_room_a_piece_is_offered_again_and_nothing_comes_between_the_pieces(
    library: Library,
) -> None:
    library.room = False
    sender = library.sender(pieces=thirds)
    sender.put(LAND)
    sender.put(PLACES[0])
    until(lambda: library.offered > 2)
    library.room = True
    library.takes(*thirds(LAND), *thirds(PLACES[0]))


def test_a_stop_does_not_wait_for_the_rest_of_a_landing(library: Library) -> None:
    sender = library.sender(pieces=thirds)
    library.hang_with(LAND)
    sender.put(STOP)
    library.free.set()
    library.takes((LAND, 0), *thirds(STOP))


def test_the_last_order_is_sent_again_unless_it_was_followed_or_is_old(library: Library) -> None:
    told: list[SentCommand] = []
    sender = library.sender(on_sent=told.append)
    sender.repeat_order(0.0)  # nothing has been sent
    sender.put(LAND)
    library.takes(LAND)
    sender.repeat_order(library.now_s + 0.1)
    library.takes()
    sender.repeat_order(library.now_s - 0.1)
    until(lambda: told)
    library.takes(LAND)
    assert told[0].sender == "reconnect"
    sender.put(PLACES[0])
    library.takes(PLACES[0])
    sender.repeat_order(0.0)
    library.takes()


def test_something_of_its_own_goes_out_only_while_no_command_waits(library: Library) -> None:
    spare = ["first", "second"]

    def send_spare() -> bool:
        return bool(spare) and library.hand_over(spare.pop(0))

    library.free.clear()
    sender = library.sender(spare=send_spare)
    assert library.called.wait(LIMIT_S)
    sender.put(LAND)
    library.free.set()
    until(lambda: len(library.taken) == 3)
    assert library.taken == ["first", LAND, "second"]


# --- A library that hangs or fails ------------------------------------------------------------


def test_a_library_that_never_returns_holds_up_no_order(library: Library) -> None:
    hung = library.free

    def tend(stuck_s: float, hangs: bool) -> None:
        if hangs:  # as a new driver would
            library.free = threading.Event()
            library.free.set()

    sender = library.sender(tend=tend)
    library.hang_with(LAND)
    sender.put(STOP)
    library.now_s += LIBRARY_HANG_S + 0.01
    library.takes(STOP)
    hung.set()  # what returns now has been given up
    until(lambda: LAND in library.taken)
    sender.put(StopMotors())
    library.takes(LAND, StopMotors())


def test_a_call_that_the_computer_slept_through_is_no_hang(library: Library) -> None:
    blamed: list[bool] = []

    def tend(stuck_s: float, hangs: bool) -> None:
        blamed.append(hangs)
        if stuck_s > LIBRARY_HANG_S:
            library.free.set()  # awake, it returns

    sender = library.sender(tend=tend)
    library.hang_with(LAND)
    library.now_s += 100.0
    assert sender.drain(LIMIT_S)
    assert not any(blamed)
    assert library.taken == [LAND]


def test_an_error_that_lasts_is_a_trouble_until_the_order_is_taken(library: Library) -> None:
    blamed: list[bool] = []
    library.error = RuntimeError("no radio")
    sender = library.sender(tend=lambda stuck_s, hangs: blamed.append(hangs))
    sender.put(LAND)
    until(lambda: library.offered > 1)
    assert sender.trouble() is None
    library.now_s += LIBRARY_HANG_S + 0.01
    until(lambda: blamed and blamed[-1])
    assert "0.5 s: no radio" in str(sender.trouble())
    library.error = None
    library.takes(LAND)
    assert sender.trouble() is None


def test_an_error_that_passes_is_counted_and_no_trouble(library: Library) -> None:
    sender = library.sender()
    assert sender.new_notes() == []
    library.error = RuntimeError("no room\nTraceback")
    sender.put(LAND)
    until(lambda: sender.errors > 2)
    library.error = None
    library.takes(LAND)
    (note,) = sender.new_notes()
    assert note.endswith(f"failed {sender.errors} times so far and was retried: no room")
    library.now_s += 100.0
    assert sender.trouble() is None
    assert sender.new_notes() == []


def test_errors_are_noted_once_a_second(library: Library) -> None:
    library.error = RuntimeError("no radio")
    sender = library.sender()
    sender.put(LAND)
    until(lambda: sender.errors)
    assert len(sender.new_notes()) == 1
    until(lambda: sender.errors > 3)
    assert sender.new_notes() == []
    library.now_s += NOTED_EVERY_S
    assert len(sender.new_notes()) == 1


def test_a_command_that_cannot_be_divided_is_in_nobodys_way(library: Library) -> None:
    def pieces(command: Command) -> list[Command]:
        if command == LAND:
            raise ValueError("no number")
        return [command]

    sender = library.sender(pieces=pieces)
    sender.put(LAND)
    sender.put(StopMotors())
    library.takes(StopMotors())
    assert sender.errors == 1
    sender.put(LAND)
    assert sender.drain(LIMIT_S)
    until(lambda: "no number" in str(sender.trouble()))  # lost, and not offered again
    sender.put(StopMotors())
    library.takes(StopMotors())
    assert sender.trouble() is None


def test_no_error_ends_a_thread(library: Library) -> None:
    """Not even one that is meant to: the watchdog's goes on, and so does the sender's."""
    asked: list[BaseException] = [SystemExit("of the guard")]

    def guard() -> Command | None:
        if asked:
            raise asked.pop()
        return STOP

    library.error = SystemExit("of the library")
    sender = library.sender(guard=guard)
    sender.put(LAND)
    until(lambda: sender.errors)
    assert "of the library" in sender.new_notes()[0]
    library.error = None
    until(lambda: STOP in library.taken)
    assert not asked


def test_a_guard_that_raises_is_a_trouble_until_it_works_again(library: Library) -> None:
    works = threading.Event()

    def guard() -> None:
        if not works.is_set():
            raise ZeroDivisionError("of the guard")

    sender = library.sender(guard=guard)
    until(lambda: "link supervision failed: of the guard" in str(sender.trouble()))
    works.set()
    until(lambda: sender.trouble() is None)


# --- The guard --------------------------------------------------------------------------------


def test_the_guard_is_asked_by_itself_and_what_it_wants_is_told(library: Library) -> None:
    """A log that fails stops nothing, and of the loop's commands it hears nothing."""
    told: list[SentCommand] = []

    def tell(each: SentCommand) -> None:
        told.append(each)
        raise OSError("the log's")

    wants = threading.Event()  # not before the loop's command is out, which a stop would replace
    sender = library.sender(guard=lambda: STOP if wants.is_set() else None, on_sent=tell)
    sender.put(PLACES[0])
    assert sender.drain(LIMIT_S)
    wants.set()
    until(lambda: len(told) >= 3)
    assert set(library.taken) == {PLACES[0], STOP}
    assert sender.trouble() is None
    assert {sent.command for sent in told} == {STOP}
    assert {sent.sender for sent in told} == {"watchdog"}


def test_a_guard_is_not_asked_for_what_cannot_go_out(library: Library) -> None:
    """It counts its orders, and would have none left when the link is back."""
    stuck: list[float] = []
    polls: list[float] = []
    sender = library.sender(
        guard=lambda: polls.append(library.now_s), tend=lambda stuck_s, hangs: stuck.append(stuck_s)
    )
    library.room = False
    sender.put(LAND)
    library.now_s += GUARD_PERIOD_S + 0.01
    until(lambda: len(stuck) > 1 and min(stuck[-2:]) > GUARD_PERIOD_S)
    before, rounds = len(polls), len(stuck)
    until(lambda: len(stuck) > rounds + 2)
    assert len(polls) == before
    library.room = True
    until(lambda: len(polls) > before)


# --- Arming -----------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [Arm(True), Arm(False)])
def test_an_arming_request_is_for_its_moment_only(order: Arm, library: Library) -> None:
    """Late it would turn the propellers after the session has ended, or stop them in the air."""
    library.room = False
    sender = library.sender()
    sender.put(order)
    library.now_s += STALE_COMMAND_S + 0.01
    sender.put(LAND)
    library.room = True
    library.takes(LAND)
    sender.put(order)
    library.takes(order)
    sender.repeat_order(0.0)  # the link was lost, and is back
    library.takes()
