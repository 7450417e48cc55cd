"""The simulated motion capture's server, read by the library that reads a lab's."""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Callable
from typing import Any

import pytest

from perchctl.errors import InvalidValue
from perchctl.positioning import BodyPose, CaptureFrame
from perchctl.sim import CaptureFault, CaptureSettings, Scenario, SimProcess
from perchctl.sim import capture as natnet
from perchctl.sim.capture import SimCapture

WAIT_S = 10.0
NAMES = ("crazyflie", "target")
SEEN = CaptureFrame(
    1.25,
    {
        "crazyflie": BodyPose((0.1, -0.2, 1.5), (0.5, 0.5, -0.5, 0.5)),
        "target": BodyPose((0.0, 0.0, 2.2), (1.0, 0.0, 0.0, 0.0)),
    },
)


class Reader:
    """The library's client, read in a thread, since it waits without a bound. Its connecting
    lets no other thread run: what answers has to be another process."""

    def __init__(self, host: str) -> None:
        library = pytest.importorskip("motioncapture", reason="needs the extra [mocap]")
        name, port = host.split(":")
        self._client = library.connect(SimCapture.SYSTEM, {"hostname": name, "port_command": port})
        self._news = threading.Condition()
        self._bodies: dict[str, Any] = {}
        threading.Thread(target=self._run, daemon=True).start()

    def until(self, seen: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Name -> (position, quaternion) of the first frame that is as wanted."""
        with self._news:
            assert self._news.wait_for(lambda: seen(self._bodies), WAIT_S), self._bodies
            return self._bodies

    def until_at(
        self, name: str, position_m: tuple[float, float, float], within_m: float
    ) -> dict[str, Any]:
        return self.until(lambda b: name in b and math.dist(b[name][0], position_m) < within_m)

    def _run(self) -> None:
        while True:
            self._client.waitForNextFrame()
            bodies = {
                name: (
                    tuple(float(v) for v in body.position),
                    (body.rotation.w, body.rotation.x, body.rotation.y, body.rotation.z),
                )
                for name, body in self._client.rigidBodies.items()
            }
            with self._news:
                self._bodies = bodies
                self._news.notify_all()


def test_a_hidden_body_is_told_from_one_at_the_origin() -> None:
    frame = natnet.frame_message(7, NAMES, CaptureFrame(1.3, {"target": SEEN.bodies["target"]}))
    kind, length = struct.unpack_from("<HH", frame)
    assert (kind, length) == (natnet.FRAME, len(frame) - 4)
    bodies = [struct.unpack_from("<i3f4ffh", frame, 4 + 16 + 38 * i) for i in range(2)]
    assert [body[-1] for body in bodies] == [0, 1]
    assert bodies[1][1:8] == pytest.approx((0.0, 0.0, 2.2, 0.0, 0.0, 0.0, 1.0))


def test_the_library_reads_the_room_of_the_vehicle_s_process() -> None:
    scenario = Scenario(extra={"external_position": 1.0})
    with SimProcess.start(scenario, "stepped", capture=CaptureSettings()) as sim:
        assert sim.capture is not None
        assert sim.capture[0] == SimCapture.SYSTEM
        first, second = Reader(sim.capture[1]), Reader(sim.capture[1])
        sim.set_pose((0.2, 0.1, 0.6), (0.0, 0.0, 1.0), hold=True)
        sim.advance(0.1)
        for reader in (first, second):  # at the same time, on one computer
            reader.until_at("crazyflie", (0.2, 0.1, 0.6), 0.006)
            seen = reader.until_at("wand", (1.2, -0.9, 0.05), 0.006)
            assert seen["crazyflie"][1] == pytest.approx(
                (math.cos(0.5), 0.0, 0.0, math.sin(0.5)), abs=0.02
            )
        sim.capture_fault(CaptureFault(scale=1000.0), 0.05)
        sim.advance(0.05)
        first.until_at("crazyflie", (200.0, 100.0, 600.0), 6.0)
        sim.advance(0.1)
        first.until_at("crazyflie", (0.2, 0.1, 0.6), 0.006)
        sim.capture_fault(CaptureFault(occluded=True))
        sim.advance(0.1)
        first.until(lambda bodies: set(bodies) == {"wand"})
        sim.capture_fault(None)
        sim.advance(0.1)
        first.until(lambda bodies: set(bodies) == {"crazyflie", "wand"})


def test_without_a_capture_there_is_none_to_spoil() -> None:
    with SimProcess.start(pace="stepped") as sim:
        assert sim.capture is None
        with pytest.raises(InvalidValue, match="without a motion capture"):
            sim.capture_fault(CaptureFault(gone=True))
