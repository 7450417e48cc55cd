"""A hand that lifts and turns a simulated vehicle, through the library's own reader and cflib:
the comparison names what is swapped, the record says so, and `fly` refuses with that name."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
pytest.importorskip("motioncapture", reason="motion capture needs the extra [mocap]")

from perchctl.check.row import Row, Verdict
from perchctl.check.session import Wanted, check
from perchctl.cli import app
from perchctl.commands.fly import FlyRequest, resolve
from perchctl.geometry import rpy_from_rotation
from perchctl.sim.capture.settings import SWAPPED_XY, TRUE_AXES, Y_UP, CaptureSettings
from perchctl.sim.process.handle import SimProcess
from perchctl.sim.scenario import Scenario
from tests.check.test_hand import LASTS_S, motion
from tests.helpers.checks import NO_CAMERA, QUICK

pytestmark = pytest.mark.usefixtures("elsewhere")
NO_DECK = Scenario(extra={"external_position": 1.0})


class Hand:
    """Moves the vehicle as `motion` says, in a thread of its own, once it is told to."""

    def __init__(self, sim: SimProcess) -> None:
        self._sim = sim
        self._thread: threading.Thread | None = None
        self._over = threading.Event()

    def told(self, text: str) -> None:
        if text.startswith("now, within"):
            self._thread = threading.Thread(target=self._move)
            self._thread.start()

    def _move(self) -> None:
        begin_s = time.monotonic()
        while (t_s := time.monotonic() - begin_s) < LASTS_S and not self._over.wait(0.01):
            place, R = motion(t_s)
            x, y, z = (float(v) for v in place)
            self._sim.set_pose((x, y, z + 0.0125), rpy_from_rotation(R), hold=True)

    def close(self) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join(10.0)


def lifted(sim: SimProcess, profile: Path) -> dict[str, Row]:
    options = resolve(FlyRequest(profile=str(profile), uri=sim.uri, source=NO_CAMERA))
    hand = Hand(sim)
    try:
        wanted = QUICK | {"lift": True, "lift_s": LASTS_S + 1.0, "capture_s": 0.5}
        return {row.name: row for row in check(options, Wanted(**wanted, tell=hand.told))}
    finally:
        hand.close()


@pytest.mark.long
@pytest.mark.parametrize(("axes", "words"), [
    (Y_UP, "swapped axes: up is y in the motion capture"),
    (SWAPPED_XY, "the rigid body's axes are turned by"),
    (TRUE_AXES, None),
])  # fmt: skip
def test_what_the_hand_finds_is_what_fly_refuses(
    axes: str, words: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    with SimProcess.start(NO_DECK, capture=CaptureSettings(axes=axes)) as sim:
        assert sim.capture is not None
        system, host = sim.capture
        profile = tmp_path / "lab.yaml"
        profile.write_text(
            "extends: sim\nlink: {connect_timeout_s: 8}\npositioning: "
            f"{{by: mocap, system: {system}, host: '{host}', connect_timeout_s: 10}}\n",
            encoding="utf-8",
        )
        words_of_fly = ["fly", "-p", str(profile), "-u", sim.uri, "--source", NO_CAMERA, "--yes"]
        before = CliRunner().invoke(app, words_of_fly)
        assert before.exit_code == 52
        assert "was never compared" in before.stderr

        rows = lifted(sim, profile)
        after = CliRunner().invoke(app, words_of_fly)
    if words is None:
        assert rows["lifted"].verdict is Verdict.PASS, rows["lifted"]
        assert rows["compared"].verdict is Verdict.PASS
        assert after.exit_code != 52, after.stderr  # the next thing: there is no such camera
        assert "camera" in after.stderr.splitlines()[-1]
        return
    assert rows["lifted"].verdict is Verdict.FAIL, rows["lifted"]
    assert words in rows["lifted"].found
    assert "fly refuses" in rows["compared"].found
    assert after.exit_code == 52
    assert words in after.stderr
    assert "(found by check --lift on " in after.stderr
    assert "connecting" not in after.stderr
