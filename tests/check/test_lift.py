"""`check --lift` whole: a simulated vehicle is carried and turned by a hand, cflib listens to it,
and the library that reads a lab's system to its motion capture."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
pytest.importorskip("motioncapture", reason="motion capture needs the extra [mocap]")

from perchctl.check import CheckScope, Row, Verdict, check
from perchctl.check.capture import COMPARED, HOW_TO_TURN
from perchctl.check.vehicle import LIFTED
from perchctl.errors import SafetyAbort
from perchctl.flight.session import require_lift_check
from perchctl.profile import Profile
from perchctl.sim import CaptureFault, CaptureSettings, SimProcess, draw_scenario
from tests.helpers.capture import SWAPPED_XY, Y_UP
from tests.helpers.carried import Hand, Stop, Stops, lifted_and_turned
from tests.helpers.checks import QUICK, options, wait_for
from tests.helpers.flights import short_profile

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("elsewhere")]

HOME = (0.0, 0.0, 0.012)
TRIES, SLOW_S, STARVED_S = 4, 0.1, 1.0
"""A vehicle that lost up to the last of these is still told right; beyond, it may not answer."""
LIFT_S = 9.0
"""The hand is back by then."""


@pytest.fixture(scope="module")
def sim() -> Iterator[SimProcess]:
    """A vehicle without a deck in a room with a motion capture, in which nobody films."""
    profile = short_profile({"positioning.by": "mocap"})
    settings = CaptureSettings(origin_m=(0.7, -0.5, 0.0), heading_rad=0.6)
    with SimProcess.start(draw_scenario(profile, 3), capture=settings) as started:
        yield started


@dataclass(frozen=True)
class Lab:
    """What somebody would have in front of them."""

    sim: SimProcess
    profile: Profile

    def lift(self, expected: Verdict) -> dict[str, Row]:
        """Each row by its name. Where it is not as expected, and the vehicle's time stood still
        meanwhile, as on a computer that is busy, it has told nothing: once more, then."""
        least_s = math.inf
        for _ in range(TRIES):
            began_s, began_t_s = time.monotonic(), self.sim.truth()["t_s"]
            rows = self._lifted()
            lasted_s = time.monotonic() - began_s
            behind_s = lasted_s - (self.sim.truth()["t_s"] - began_t_s)
            least_s = min(least_s, behind_s)
            if rows[LIFTED].verdict is expected or behind_s < SLOW_S:
                return rows
        if least_s > STARVED_S:
            pytest.skip(f"no real time on this computer: {least_s:.1f} s lost at each try")
        return rows

    def _lifted(self) -> dict[str, Row]:
        """The hand takes it when the command says so."""

        def tell(text: str) -> None:
            if HOW_TO_TURN in text:
                self.sim.move_by_hand(Hand(lifted_and_turned(HOME)))

        self._put_down()
        quick = CheckScope(**QUICK)
        wanted = replace(
            quick, with_lift=True, lift_s=LIFT_S, listen_s=0.5, capture_s=0.5, announce=tell
        )
        found = check(options(self.sim.uri, profile=self.profile), wanted)
        return {row.name: row for row in found}

    def _put_down(self) -> None:
        """By a hand, too: what is put somewhere else no gyroscope follows."""
        self.sim.move_by_hand(Hand(Stops((Stop(0.5, HOME),))))
        end_s = time.monotonic() + 20.0
        while math.dist(self.sim.truth()["position_m"], HOME) > 1e-3:
            assert time.monotonic() < end_s
            time.sleep(0.02)
        wait_for(self.sim, 0.5)

    def may_fly(self) -> None:
        """Raises SafetyAbort."""
        require_lift_check(self.profile.positioning, self.sim.uri, simulated=False)


def lab(sim: SimProcess, **changes: Any) -> Lab:
    assert sim.capture is not None
    system, host = sim.capture
    at = {"by": "mocap", "system": system, "host": host} | changes
    return Lab(sim, short_profile({f"positioning.{key}": value for key, value in at.items()}))


@pytest.fixture(autouse=True)
def no_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def test_a_capture_that_is_set_up_right_passes_and_may_be_flown_by(sim: SimProcess) -> None:
    it = lab(sim)
    with pytest.raises(SafetyAbort, match="never been compared"):
        it.may_fly()
    rows = it.lift(Verdict.PASS)
    lifted = rows[LIFTED]
    assert lifted.verdict is Verdict.PASS, lifted
    assert "rotation agrees with" in lifted.found
    assert rows["body place"].verdict is Verdict.PASS
    assert rows[COMPARED].verdict is Verdict.PASS
    it.may_fly()


@pytest.mark.parametrize(("fault", "body", "words"), [
    (CaptureFault(axes=Y_UP), "crazyflie", "swapped axes: up is y"),
    (CaptureFault(axes=SWAPPED_XY), "crazyflie", r"are rotated by (8[5-9]|9.) deg"),
    (CaptureFault(scale=1000.0), "crazyflie", "the positions appear to be in millimetres"),
    (None, "wand", "the vehicle moves while the rigid body 'wand' does not"),
])  # fmt: skip
def test_what_is_set_up_wrong_is_named_and_not_flown_by(
    sim: SimProcess, fault: CaptureFault | None, body: str, words: str
) -> None:
    it = lab(sim, body=body)
    if fault is not None:
        sim.begin_fault(fault)
    try:
        rows = it.lift(Verdict.FAIL)
    finally:
        sim.end_faults()
    assert rows[LIFTED].verdict is Verdict.FAIL, rows[LIFTED]
    assert re.search(words, rows[LIFTED].found)
    with pytest.raises(SafetyAbort, match="with the hand-held vehicle on"):
        it.may_fly()
