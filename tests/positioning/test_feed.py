"""What reaches the vehicle of what a motion-capture system says, and what does not."""

from __future__ import annotations

import math
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import (
    make_T,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
    rpy_from_rotation,
)
from perchctl.positioning import BodyPose, CaptureFrame, FeedStatus, PositionFeed, VehiclePose
from perchctl.positioning import feed as feeding
from perchctl.positioning.feed import QUIET_S, STALE_FRAME_S
from perchctl.profile import PositioningConfig
from perchctl.vehicle import ExternalPosition

FEW = settings(max_examples=20)  # each example is a flight
CONFIG = PositioningConfig(by="mocap", host="lab", body="cf", latency_s=0.01)
LEVEL = (1.0, 0.0, 0.0, 0.0)
angles = st.floats(-3.0, 3.0)
metres = st.floats(-4.0, 4.0)


class Script:
    """A capture whose frames are put into it."""

    def __init__(self) -> None:
        self.frame: CaptureFrame | None = None
        self.trouble: str | None = None

    def poll(self, now_s: float) -> CaptureFrame | None:
        frame, self.frame = self.frame, None
        return frame

    def problem(self, now_s: float) -> str | None:
        return self.trouble

    def close(self) -> None:
        return None


class Rig:
    """A feed in turns of 10 ms; what is sent is in `places`."""

    def __init__(self, config: PositioningConfig = CONFIG) -> None:
        self.capture, self.now_s = Script(), 100.0
        self.places: list[ExternalPosition] = []
        self.taken = True
        self.feed = PositionFeed(self.capture, self._send, config)
        self._count = 0

    def _send(self, place: ExternalPosition) -> bool:
        if self.taken:
            self.places.append(place)
        return self.taken

    def frame(self, bodies: dict[str, BodyPose], age_s: float = 0.0) -> FeedStatus:
        self.now_s += 0.01
        self.capture.frame = CaptureFrame(self.now_s - age_s, bodies)
        self.feed.poll_and_send(self.now_s)
        return self.feed.status(self.now_s)

    def at(
        self, x_m: float, y_m: float = 0.0, *, turned: float = 0.0, age_s: float = 0.0
    ) -> FeedStatus:
        """The body at a place, with the noise of a real system."""
        self._count += 1
        q = quaternion_from_rotation(rotation_from_rpy(0.0, 0.0, turned))
        pose = BodyPose((x_m, y_m, 0.5 + 1e-5 * (self._count % 7)), q)
        return self.frame({"cf": pose, "wand": pose}, age_s)

    def idle(self, duration_s: float) -> FeedStatus:
        for _ in range(round(duration_s / 0.01)):
            self.now_s += 0.01
            self.feed.poll_and_send(self.now_s)
        return self.feed.status(self.now_s)


@given(
    st.tuples(angles, angles, angles),
    st.tuples(angles, angles, angles),
    st.tuples(metres, metres, metres),
    st.tuples(*(st.floats(-0.3, 0.3),) * 3),
)
def test_the_marker_frame_is_turned_and_moved_into_the_body_axes(
    body_rpy: tuple[float, float, float],
    rigid_rpy: tuple[float, float, float],
    position_m: tuple[float, float, float],
    offset_m: tuple[float, float, float],
) -> None:
    config = CONFIG.model_copy(
        update={
            "body_rpy_deg": tuple(math.degrees(a) for a in rigid_rpy),
            "body_position_m": offset_m,
        }
    )
    T_world_body = make_T(rotation_from_rpy(*body_rpy), position_m)
    T_world_rigid = T_world_body @ make_T(rotation_from_rpy(*rigid_rpy), offset_m)
    pose = BodyPose(tuple(T_world_rigid[:3, 3]), quaternion_from_rotation(T_world_rigid[:3, :3]))
    placed = VehiclePose.of(pose, config)
    np.testing.assert_allclose(make_T(placed.R, placed.position_m), T_world_body, atol=1e-8)


def test_the_age_counts_from_the_exposure() -> None:
    rig = Rig()
    assert math.isinf(rig.feed.status(rig.now_s).age_s)
    status = rig.at(1.0)
    assert status.age_s == pytest.approx(CONFIG.latency_s)
    assert status.sent == 1
    assert status.problem is None
    assert status.pose == rig.places[-1]
    assert rig.idle(0.05).age_s == pytest.approx(CONFIG.latency_s + 0.05)


def test_position_alone_or_with_the_attitude() -> None:
    plain, full = Rig(), Rig(CONFIG.model_copy(update={"send": "pose"}))
    plain.at(1.0, turned=0.7)
    full.at(1.0, turned=0.7)
    assert plain.places[0].quaternion is None
    quaternion = full.places[0].quaternion
    assert quaternion is not None
    assert rpy_from_rotation(rotation_from_quaternion(quaternion))[2] == pytest.approx(0.7)


@pytest.mark.parametrize("rate_hz", [10.0, 30.0, 70.0, 100.0])
@FEW
@given(st.lists(st.floats(0.001, 0.1), min_size=3, max_size=8))
def test_never_more_than_the_rate(rate_hz: float, steps_s: list[float]) -> None:
    rig = Rig(CONFIG.model_copy(update={"rate_hz": rate_hz}))
    times: list[float] = []
    for i in range(60):
        rig.now_s += steps_s[i % len(steps_s)] - 0.01
        rig.at(1.0)
        times += [rig.now_s] * (len(rig.places) - len(times))
    for first_s in times:
        assert sum(first_s <= t_s < first_s + 0.5 for t_s in times) <= 0.5 * rate_hz + 2


def posed(*position_m: float, q: tuple[float, float, float, float] = LEVEL) -> dict[str, BodyPose]:
    return {"cf": BodyPose((position_m[0], position_m[1], position_m[2]), q)}


@pytest.mark.parametrize(("bodies", "late_s", "words"), [
    ({"cf2": BodyPose((3.0, 0.0, 0.0), LEVEL)}, 0.0,
     "motion capture at vicon:lab does not see the rigid body 'cf'; it sees cf2"),
    (posed(1.2, 0.0, 0.5), STALE_FRAME_S + 0.005, "old on arrival"),
    (posed(math.nan, 0.0, 0.5), 0.0, "an invalid pose"),
    (posed(1.0, 0.0, 0.5, q=(1.0, 0.3, 0.0, 0.0)), 0.0, "an invalid pose"),
    (posed(1.0, 0.0, 0.5, q=(math.nan, 0.0, 0.0, 0.0)), 0.0, "an invalid pose"),
])  # fmt: skip
def test_what_may_not_be_believed_is_not_sent_and_named(
    bodies: dict[str, BodyPose], late_s: float, words: str
) -> None:
    rig = Rig()
    rig.at(1.0)
    for _ in range(15):
        status = rig.frame(bodies, late_s)
    assert len(rig.places) == 1
    assert status.age_s == pytest.approx(0.15 + CONFIG.latency_s)
    assert words in (status.problem or "")
    rig.now_s += 0.1
    assert rig.at(1.0, age_s=STALE_FRAME_S - 0.005).problem is None
    assert len(rig.places) == 2


def test_one_frame_without_the_body_is_no_problem() -> None:
    """VRPN's frames hold only what has moved on since the last."""
    rig = Rig()
    for i in range(40):
        status = rig.at(1.0) if i % 2 else rig.frame({})
        if i > 1:
            assert status.problem is None


def test_a_frame_is_read_once_and_a_stamp_from_the_future_is_not_fresh_for_longer() -> None:
    rig = Rig()
    rig.at(1.0)
    frame = CaptureFrame(rig.now_s, posed(1.0, 0.0, 0.5003))
    for _ in range(3):
        rig.now_s += 0.01
        rig.capture.frame = frame  # stamped as the one before
        rig.feed.poll_and_send(rig.now_s)
    assert len(rig.places) == 1
    for count in (2, 3):
        status = rig.at(1.0, age_s=-5.0)
        assert (status.age_s, status.sent) == (pytest.approx(CONFIG.latency_s), count)


def test_a_frozen_body_is_not_sent_twice_and_ages_from_its_first_frame() -> None:
    """What is compared are all seven numbers: a turn on the spot is news."""
    rig = Rig()
    rig.frame(posed(1.0, 0.0, 0.5))
    status = rig.frame(posed(1.0, 0.0, 0.5))
    assert status.problem is None  # a filter repeats itself for a frame or two
    for _ in range(18):
        status = rig.frame(posed(1.0, 0.0, 0.5))
    assert len(rig.places) == 1
    assert status.age_s == pytest.approx(0.19 + CONFIG.latency_s)
    assert "frozen" in (status.problem or "")
    turned = posed(1.0, 0.0, 0.5, q=(math.cos(1e-4), 0.0, 0.0, math.sin(1e-4)))
    for news in (posed(1.0, 0.0, 0.50001), turned):
        assert rig.frame(news).problem is None
    assert len(rig.places) == 3


@FEW
@given(st.floats(0.2, 5.0), st.floats(-0.4, 0.4), st.floats(0.1, 2.0))
def test_another_body_is_not_believed_however_long_it_stays(
    aside_m: float, speed_mps: float, lasting_s: float
) -> None:
    """Fault 11. With time a vehicle could have flown there; it is refused all the same."""
    rig = Rig()
    for _ in range(5):
        rig.at(1.0)
    sent = len(rig.places)
    status = FeedStatus()
    for i in range(round(lasting_s / 0.01)):
        status = rig.at(1.0 + aside_m + speed_mps * 0.01 * i, turned=0.1)
        if abs(aside_m + speed_mps * 0.01 * i) < 0.15:
            return  # it has come to where the body was left: nothing tells them apart
        assert len(rig.places) == sent
    if lasting_s > QUIET_S + 0.02:
        assert "jumped by" in (status.problem or "")
    assert status.age_s >= lasting_s
    rig.at(1.0)
    assert len(rig.places) == sent + 1


@FEW
@given(st.floats(-3.0, 3.0), st.floats(-4.0, 4.0))
def test_a_body_in_flight_is_believed(speed_mps: float, turning_radps: float) -> None:
    rig = Rig()
    for i in range(40):
        rig.at(1.0 + speed_mps * 0.01 * i, turned=turning_radps * 0.01 * i)
    assert len(rig.places) == 40
    for _ in range(30):  # hidden for a moment
        rig.frame({})
    rig.at(1.0 + speed_mps * 0.01 * 40, turned=turning_radps * 0.01 * 40)
    assert len(rig.places) == 41
    rig.at(1.0 + speed_mps * 0.01 * 40, turned=turning_radps * 0.01 * 40 + math.pi / 2)
    assert len(rig.places) == 41, "a marker set with a symmetry is seen turned now and then"


def test_a_link_that_does_not_take_it_and_a_stop_let_the_age_grow() -> None:
    rig = Rig()
    rig.at(1.0)
    rig.taken = False
    for _ in range(15):
        status = rig.at(1.0)
    assert (status.sent, status.age_s > 0.15) == (1, True)
    assert "busy" in (status.problem or "")
    rig.taken = True
    assert rig.at(1.0).sent == 2
    rig.feed.stop()  # what contradicts the vehicle is sent no more
    for _ in range(20):
        status = rig.at(1.0)
    assert (status.sent, status.age_s > 0.15) == (2, True)
    assert "accelerometer" in (status.problem or "")


def test_silence_a_source_that_is_gone_or_broken_and_a_thread_that_hangs_are_named() -> None:
    rig = Rig()
    assert rig.feed.status(rig.now_s).problem is not None
    rig.at(1.0)
    assert "for 0.3 s" in (rig.idle(0.3).problem or "")
    rig.capture.trouble = "motion capture at vicon:lab has ended"
    assert rig.idle(0.01).problem == rig.capture.trouble
    assert "has been passed on for" in (rig.feed.status(rig.now_s + 1.0).problem or "")
    rig.capture.poll = lambda now_s: 1 / 0  # type: ignore[method-assign, assignment, return-value]
    assert "ZeroDivisionError" in (rig.idle(0.2).problem or "")


def test_a_thread_that_hangs_in_the_link_is_named_and_holds_nobody_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(feeding, "END_TIMEOUT_S", 0.05)
    capture, entered, free = Script(), threading.Event(), threading.Event()
    capture.frame = CaptureFrame(time.monotonic(), {"cf": BodyPose((1.0, 0.0, 0.5), LEVEL)})
    sent: list[ExternalPosition] = []

    def hang(place: ExternalPosition) -> bool:
        entered.set()
        assert free.wait(10.0)
        sent.append(place)
        return True

    feed = PositionFeed(capture, hang, CONFIG)
    feed.start(time.monotonic)
    assert entered.wait(10.0)
    status = feed.status(time.monotonic() + 1.0)
    assert status.sent == 0
    assert status.problem is not None
    feed.close()
    assert sent == []
    capture.frame = CaptureFrame(time.monotonic(), {"cf": BodyPose((1.1, 0.0, 0.5), LEVEL)})
    free.set()
    assert feed._thread is not None
    feed._thread.join(10.0)
    assert len(sent) == 1  # after `close` no other follows
