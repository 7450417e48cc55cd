"""A radio that falls silent, breaks and comes back, under the installed cflib.

Threads are cflib's and perchctl's own. Each wait is for an event and bounded; how long the radio is
silent is what is tested, and cflib's bound of 2 s for a packet cannot be shortened.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from cflib.crtp import radiodriver
from cflib.crtp.crtpstack import CRTPPacket

from perchctl.link import CflibLink, Packet, Port
from perchctl.link import connection as connection_room
from perchctl.link.crtp import encode
from perchctl.mission import SentCommand
from perchctl.profile import LinkConfig
from perchctl.sim import Scenario
from perchctl.vehicle import Command, EmergencyStop, Land, PositionSetpoint
from tests.helpers.radio import FORGETS_LOGS_S, URI, Air, plug_in
from tests.helpers.waiting import Stopwatch, stopwatch

OTHER_URI = "radio://0/81/2M/E7E7E7E7E7"
FLOOR = Scenario(mass_kg=0.036, ceiling_z_m=0.9)
CONFIG = LinkConfig(connect_timeout_s=60.0, parameters={"stabilizer.estimator": 2})
HOLD = PositionSetpoint(0.0, 0.0, 0.0, 0.0)  # on the floor
LAND = Land(-0.05, 1.5)
CREATE_BLOCK, START_BLOCK = 6, 3
STREAM_S = 0.02
CFLIB_WAITS_S = 2.0  # for room in its driver, before it reports the link's end
BACK_S = 0.5  # after the radio answers again
LIMIT_S = 5.0  # of a wait that a test hopes for; reached only when it fails
PAUSE = threading.Event()


@dataclass
class Flown:
    """A connected vehicle on the floor, behind a radio."""

    air: Air
    link: CflibLink

    @property
    def cf(self) -> Any:
        assert self.link.connection is not None
        return self.link.connection.cf

    def error_callback(self) -> Callable[[str], None]:
        """What the driver calls with the reason of its end."""
        callback: Callable[[str], None] = self.cf.link.link_error_callback
        return callback

    def problem(self) -> str | None:
        return self.link.problem(time.monotonic())

    def until(self, true: Callable[[], Any]) -> float:
        """Wait, and how long that took."""
        began_s = time.monotonic()
        while not true():
            assert time.monotonic() - began_s < LIMIT_S
            PAUSE.wait(0.005)
        return time.monotonic() - began_s

    def stream(self, for_s: float) -> float:
        """As the flight loop does; the longest that one call of the link took, but for the time in
        which another program had the processor."""

        def turn() -> None:
            self.link.send(HOLD)
            self.link.telemetry()
            self.problem()

        with stopwatch() as watch:
            return watch.longest_call_s(turn, lambda: PAUSE.wait(STREAM_S), for_s)

    def after_streaming(self, true: Callable[[], Any]) -> Any:
        """Stream for a moment, and then what `true` returns."""
        self.stream(STREAM_S)
        return true()

    def answers_again(self) -> float:
        """The radio does; when that was."""
        self.air.silent.clear()
        return time.monotonic()

    def heard_after_s(self, command: Command, since_s: float) -> float:
        """How long after then the last packet of a command reached the vehicle."""
        at_s = self.air.hears(lambda packet: packet == encode(command)[-1], since_s, LIMIT_S)
        assert at_s is not None, f"{command} does not go out: {self.problem()}"
        return at_s - since_s

    def is_heard(self, command: Command, since_s: float) -> bool:
        return self.air.hears(lambda p: p == encode(command)[-1], since_s, 0.0) is not None

    def log_blocks(self, since_s: float = 0.0) -> list[Packet]:
        """What created and started them, as the vehicle heard it."""
        heard = [p for t_s, p in self.air.heard if t_s >= since_s and p.port == Port.LOG]
        return [p for p in heard if p.channel == 1 and p.data[0] in (CREATE_BLOCK, START_BLOCK)]

    def await_telemetry(self) -> None:
        """Until what the vehicle measures from now on arrives, and nothing is wrong."""
        now_s = time.monotonic()
        self.until(lambda: any(sample.t_s > now_s for sample in self.link.telemetry()))
        self.until(lambda: self.problem() is None)


@contextmanager
def connection(cache: Any, uri: str = URI) -> Iterator[Flown]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        air = Air(FLOOR)
        plug_in(air, patch)
        link = CflibLink(uri, CONFIG, time.monotonic, landing_wait_s=0.2)
        link.connect()
        yield Flown(air, link)
        link.close()


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return tmp_path_factory.getbasetemp() / "cache"


@pytest.fixture(scope="module")
def connected(cache: Any) -> Iterator[Flown]:
    with connection(cache) as flown:
        yield flown


@pytest.fixture
def flown(connected: Flown) -> Iterator[Flown]:
    """Whatever the last test did to it."""
    connected.await_telemetry()
    yield connected
    connected.air.unplugged.clear()
    connected.air.silent.clear()
    connected.link.set_guard(OperatorRequest().guard)


class OperatorRequest:
    """Sends the operator's stop as the link's guard once it was pressed."""

    def __init__(self) -> None:
        self.pressed = False

    def guard(self, *_: object) -> Command | None:
        return EmergencyStop() if self.pressed else None


# --- The measure itself -----------------------------------------------------------------------


def test_a_call_that_hangs_is_measured_whatever_starves_the_others() -> None:
    """Twenty calls that another program delays, and one that hangs by itself."""
    now_s = 0.0
    delayed = [(0.015, 0.015)] * 10
    script = iter([*delayed, (0.3, 0.0), *delayed])

    def call() -> None:
        nonlocal now_s
        took_s, starved_s = next(script)
        now_s += took_s
        watch.starved_s += starved_s

    def pause() -> None:
        nonlocal now_s
        now_s += STREAM_S

    watch = Stopwatch(lambda: now_s)
    assert watch.longest_call_s(call, pause, 0.9) == pytest.approx(0.3)


# --- Silence ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "silent_s", [CFLIB_WAITS_S + 0.2, *(pytest.param(s, marks=pytest.mark.long) for s in (5, 10))]
)
def test_after_silence_a_landing_and_a_stop_go_out_again(flown: Flown, silent_s: float) -> None:
    """A landing that is ordered in the silence, and a stop after it; nothing waits."""
    flown.air.silent.set()
    longest_s = flown.stream(silent_s)
    problem = flown.problem()
    flown.link.send(LAND)
    back_s = flown.answers_again()
    assert flown.heard_after_s(LAND, back_s) < BACK_S
    flown.link.send(EmergencyStop())
    assert flown.heard_after_s(EmergencyStop(), back_s) < 2 * BACK_S
    flown.await_telemetry()
    assert longest_s < 0.1
    assert problem is not None


def test_the_operators_stop_goes_out_after_silence_though_the_loop_hangs(flown: Flown) -> None:
    operator = OperatorRequest()
    flown.link.set_guard(operator.guard)
    flown.air.silent.set()
    flown.stream(0.2)  # and then nothing of the loop's
    PAUSE.wait(CFLIB_WAITS_S)
    operator.pressed = True
    back_s = flown.answers_again()
    assert flown.heard_after_s(EmergencyStop(), back_s) < BACK_S


def test_half_a_second_without_room_is_a_problem_and_less_is_none(flown: Flown) -> None:
    flown.air.silent.set()
    passed_s = flown.until(lambda: flown.after_streaming(flown.problem))
    assert 0.5 <= passed_s < 1.0


def test_a_radio_that_is_only_out_of_reach_is_waited_for(flown: Flown) -> None:
    """Opening it again would reset the dongle. The vehicle forgets its log blocks meanwhile, and is
    told what cflib had told it."""
    opened, told = flown.air.opened, set(flown.log_blocks())
    flown.air.silent.set()
    flown.stream(FORGETS_LOGS_S + 0.5)
    back_s = flown.answers_again()
    came: set[str] = set()
    for block in flown.cf.log.log_blocks:
        block.data_received_cb.add_callback(lambda _stamp, _data, block: came.add(block.name))
    flown.until(lambda: len(came) == len(flown.cf.log.log_blocks))
    flown.await_telemetry()
    assert set(flown.log_blocks(back_s)) == told
    assert flown.air.opened == opened


# --- An end of the driver ---------------------------------------------------------------------


def test_a_driver_that_gives_the_radio_up_is_replaced_by_one_that_is_heard(
    flown: Flown, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the driver's own thread. One that opens while the vehicle is out of reach has no
    safelink, and would be heard once and never again."""
    monkeypatch.setattr(radiodriver, "_nr_of_retries", 30)
    flown.stream(0.1)  # the driver takes it up at the next answer
    flown.air.silent.set()
    flown.until(lambda: "Too many packets lost" in str(flown.problem()))
    monkeypatch.undo()
    flown.stream(0.5)
    back_s = flown.answers_again()
    for number in range(1, 6):
        place = PositionSetpoint(0.0, 0.0, 0.0, 0.01 * number)
        flown.until(lambda place=place: flown.link.send(place) or flown.is_heard(place, back_s))
    flown.await_telemetry()


def test_an_error_inside_a_call_of_cflibs_leaves_its_lock_free(flown: Flown) -> None:
    """Whoever calls: cflib's own threads do, with their answers to the vehicle."""
    cf = flown.cf
    flown.air.silent.set()
    for _ in range(3):
        caller = threading.Thread(target=cf.send_packet, args=(CRTPPacket(0xF3),), daemon=True)
        caller.start()
    flown.until(lambda: flown.problem() is not None)
    caller.join(LIMIT_S)
    assert not caller.is_alive()
    back_s = flown.answers_again()
    flown.link.send(LAND)
    assert flown.heard_after_s(LAND, back_s) < BACK_S


def test_a_driver_that_holds_a_command_for_good_is_given_up_with_its_lock(
    flown: Flown, monkeypatch: pytest.MonkeyPatch
) -> None:
    connection, causes = flown.link.connection, list[str]()
    assert connection is not None
    reopen, hold = connection.reopen, threading.Event()
    monkeypatch.setattr(connection, "reopen", lambda *why: (causes.extend(why), reopen(*why)))
    monkeypatch.setattr(flown.cf.link, "send_packet", lambda packet: hold.wait())
    lock = flown.cf._send_lock
    began_s = time.monotonic()
    flown.link.send(LAND)
    flown.heard_after_s(LAND, began_s)
    flown.link.send(EmergencyStop())
    flown.heard_after_s(EmergencyStop(), began_s)
    assert lock.locked()
    assert "cflib" in causes[0]
    hold.set()


@pytest.mark.parametrize("is_first", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_late_error_of_a_driver_that_was_given_up_does_not_end_the_next(
    is_first: bool, flown: Flown, cache: Any
) -> None:
    """The driver tells its end twice, late the second time; also the one that cflib opened itself,
    with cflib's own word for its end."""
    with connection(cache, OTHER_URI) if is_first else nullcontext(flown) as flown:
        flown.await_telemetry()
        late = flown.error_callback()
        late("unplugged")
        assert flown.problem() == "unplugged"
        flown.until(lambda: flown.problem() is None)
        late("once more")
        assert flown.problem() is None
        flown.await_telemetry()
        began_s = time.monotonic()
        flown.link.send(LAND)
        flown.heard_after_s(LAND, began_s)


def test_an_order_that_may_have_been_lost_with_the_link_is_sent_again(flown: Flown) -> None:
    told: list[SentCommand] = []
    flown.link.set_guard(OperatorRequest().guard, told.append)
    began_s = time.monotonic()
    flown.link.send(LAND)
    flown.heard_after_s(LAND, began_s)
    flown.error_callback()("unplugged")
    flown.until(lambda: told)
    assert [(sent.sender, sent.command) for sent in told] == [("reconnect", LAND)]


def test_a_dongle_that_was_pulled_out_and_put_in_again_goes_on(flown: Flown) -> None:
    driver, opened = flown.cf.link, flown.air.opened
    flown.air.unplugged.set()
    flown.until(lambda: flown.after_streaming(lambda: flown.cf.link is not driver))
    assert flown.problem() is not None
    began_s = time.monotonic()
    flown.link.send(EmergencyStop())
    flown.air.unplugged.clear()
    flown.heard_after_s(EmergencyStop(), began_s)
    assert flown.air.opened == opened + 1
    flown.await_telemetry()


def test_closing_in_silence_is_bounded_and_says_no_farewell(cache: Any) -> None:
    with connection(cache, OTHER_URI) as flown:
        flown.stream(0.1)
        heard = len(flown.air.heard)
        flown.air.silent.set()
        flown.stream(0.1)
        began_s = time.monotonic()
        flown.link.close()
        assert time.monotonic() - began_s < LIMIT_S
        flown.answers_again()
        assert not any(p.port == Port.COMMANDER for _, p in flown.air.heard[heard:])


# --- What perchctl relies on in cflib ---------------------------------------------------------


def test_the_installed_cflib_has_what_the_link_looks_at(flown: Flown) -> None:
    """All of it is private or may change; where it is missing, the link goes on without."""
    cf, driver = flown.cf, flown.cf.link
    assert driver.out_queue.maxsize == 1
    assert driver._thread.is_alive()
    assert isinstance(driver._thread._retry_before_disconnect, int)
    assert driver.needs_resending is False
    assert isinstance(cf._send_lock, type(threading.Lock()))
    assert driver.link_error_callback.func == flown.link.connection._on_error
    assert radiodriver.RadioManager._radios[0].is_alive()
    assert radiodriver._nr_of_retries == connection_room.RADIO_RETRIES


def test_cflib_sends_nothing_by_itself(flown: Flown) -> None:
    """Its pings would wait for the lock, and its error handler for them."""
    heard = len(flown.air.heard)
    flown.air.hears(lambda packet: False, 0.0, 0.3)
    sent = [packet for _, packet in flown.air.heard[heard:]]
    assert [p for p in sent if p.port != Port.LOG] == []  # which may be perchctl's, after a silence
