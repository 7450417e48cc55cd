"""How a flight ended: where it met the target, how hard it met the floor, and what it showed of the
camera's latency and mounting. None of it needs a simulator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.mission.belief.belief import ContactOffset
from perchctl.mission.belief.contact import DOWN, contact_offset
from perchctl.mission.context import Context
from perchctl.mission.observation import Observation
from perchctl.mission.phase import Claim, Outcome, Phase
from perchctl.mission.records import Event
from perchctl.mission.rest import RestState, find_rest_state
from perchctl.mission.state import PlannerState
from perchctl.mission.table import TABLE
from perchctl.profile import CameraConfig, Profile
from perchctl.values import replace
from perchctl.vehicle import LOCKED
from perchctl.vision import CameraErrors

HARD_MPS = 0.6
"""No descent that goes as it should meets the floor faster."""
TOUCHDOWN_WITHIN_S = 5.0
"""Time from a touchdown to the motors' stop: an earlier blow was no floor."""
SAME_HEIGHT_M = 0.3
"""A blow higher above the present place was none by the floor."""
SURE = 1.96
"""Standard deviations on both sides of a 95 % interval."""
LATENCY_GATE_S = 0.02
"""Error of the latency that advice is given on: 30 ms make an alignment swing by centimetres."""
TURN_GATE_DEG = 2.0
"""The same of a turn: 35 mm at 1 m, more than the cone of an ascent forgives."""


def claims_of(row_name: str) -> Claim:
    """The claims of the built-in row with this name, as a log holds it; none for any other name, as
    of your own rows."""
    return next((row.claims for row in TABLE if row.name == row_name), Claim.NONE)


@dataclass(frozen=True)
class Touchdown:
    """The downward speed on meeting the floor, and the largest acceleration of 10 ms samples."""

    speed_mps: float
    peak_g: float

    @property
    def is_hard(self) -> bool:
        """True if the vehicle met the floor faster than `HARD_MPS`."""
        return self.speed_mps > HARD_MPS

    @property
    def text(self) -> str:
        """The touchdown in words, as in ``touched down hard: 1.4 m/s, 3.2 g``."""
        how = "touched down hard" if self.is_hard else "touched down"
        return f"{how}: {self.speed_mps:.1f} m/s, {self.peak_g:.1f} g"


@dataclass(frozen=True)
class Findings:
    """Latency, and the camera's turn from what the profile says about body x, y and z, each with
    one standard deviation; `advice` in sentences, empty if the profile fits, and for a simulated
    vehicle: its camera is the scenario's, and tells nothing of a real one."""

    latency_s: float
    latency_sigma_s: float
    turn_deg: tuple[float, float, float]
    turn_sigma_deg: tuple[float, float, float]
    advice: tuple[str, ...] = ()

    @classmethod
    def of(cls, seen: CameraErrors, camera: CameraConfig, *, simulated: bool = False) -> Findings:
        """The findings by a flight's estimates, with advice on each error whose 95 % interval lies
        beyond its limit; none if the flight was `simulated`."""
        latency_s = camera.start_latency_s + seen.delay_s
        x, y, z = (math.degrees(turn) for turn in seen.turn_rad)
        sx, sy, sz = (math.degrees(sigma) for sigma in seen.turn_sigma_rad)
        found, advice = cls(latency_s, seen.delay_sigma_s, (x, y, z), (sx, sy, sz)), []
        if simulated:
            return found
        set_here = not isinstance(camera.latency_s, str)  # else the measured one is used
        if set_here and _is_off(seen.delay_s, LATENCY_GATE_S, seen.delay_sigma_s):
            advice.append(
                f"latency {found.latency_text}, profile says {camera.start_latency_s * 1e3:.0f}: "
                f"set camera.latency_s to {max(0.0, latency_s):.3f}"
            )
        turns = zip(found.turn_deg, found.turn_sigma_deg, strict=True)
        if any(_is_off(turn, TURN_GATE_DEG, sigma) for turn, sigma in turns):
            advice.append(
                f"the camera is turned by {found.turn_text} from what the profile says: measure it "
                f"with `perchctl calibrate mount`"
            )
        return replace(found, advice=tuple(advice))

    @property
    def latency_text(self) -> str:
        """The latency with its 95 % interval, as in ``92 +- 6 ms``."""
        return f"{self.latency_s * 1e3:.0f} +- {SURE * self.latency_sigma_s * 1e3:.0f} ms"

    @property
    def turn_text(self) -> str:
        """The turn about x, y and z with 95 % intervals, as in
        ``0.2 +- 0.6, -0.1 +- 0.6, 0.4 +- 1.8 deg``."""
        each = zip(self.turn_deg, self.turn_sigma_deg, strict=True)
        return ", ".join(f"{turn:.1f} +- {SURE * sigma:.1f}" for turn, sigma in each) + " deg"


def _is_off(off: float, gate: float, sigma: float) -> bool:
    """True if it is beyond the gate, and its 95 % interval is narrower than it is itself."""
    return abs(off) > max(gate, 2.0 * SURE * sigma)


@dataclass(frozen=True)
class FlightReport:
    """How a flight ended, and what it showed."""

    phase: Phase
    outcome: Outcome
    reason: str
    attempts: int
    duration_s: float
    locked: bool
    history: tuple[Event, ...] = ()  # its phases' events, the first at the start
    findings: Findings | None = None  # of latency and mounting, where it was long enough
    contact: ContactOffset | None = None  # of what hangs
    touchdown: Touchdown | None = None  # of what met the floor
    detached: tuple[str, ...] = ()  # a sentence for each watcher that raised, and was left out

    @property
    def blames_profile(self) -> bool:
        """True if a row decided in the flight that claims the profile may be wrong."""
        return any(Claim.PROFILE_SUSPECT in event.claims for event in self.history)

    @classmethod
    def of(
        cls,
        state: PlannerState,
        obs: Observation,
        profile: Profile,
        history: tuple[Event, ...],
        consistency: CameraErrors | None,
        *,
        simulated: bool = False,
    ) -> FlightReport:
        """The report of a mission that is over, by its last tick; `simulated`: the vehicle was."""
        b = state.belief.seen(obs, profile)
        hangs, contact = state.phase is Phase.PERCHED, b.contact
        if hangs and contact is None:  # it was caught on its way down
            contact = contact_offset(b)
        placed = hangs and contact is not None and math.isfinite(contact.sigma_m)
        return cls(
            phase=state.phase,
            outcome=state.outcome or Outcome.SAFETY,
            reason=_reason(state, history),
            # A hold that is noticed once the attempts are used up has been counted as failed.
            attempts=state.attempts + int(hangs and state.outcome is not Outcome.ATTEMPTS_USED_UP),
            duration_s=obs.t_s - state.started_s,
            # The telemetry at hand is older than an emergency stop, which always locks.
            locked=obs.telemetry.has_bit(LOCKED) or state.outcome is Outcome.EMERGENCY,
            history=history,
            findings=None
            if consistency is None
            else Findings.of(consistency, profile.camera, simulated=simulated),
            contact=contact if placed else None,
            touchdown=find_touchdown(Context(replace(state, belief=b))),
        )


@dataclass(frozen=True)
class Rest:
    """Where a vehicle came to rest, and how hard it met the floor if it did."""

    state: RestState
    touchdown: Touchdown | None = None

    @property
    def text(self) -> str:
        """The rest in words without a full stop, with its touchdown if that was hard."""
        if self.touchdown is None or not self.touchdown.is_hard:
            return self.state.value
        return f"{self.state.value}; it {self.touchdown.text}"


def find_rest(state: PlannerState, obs: Observation, profile: Profile, off_s: float) -> Rest | None:
    """Return where the vehicle is; None until its motors have been seen off for `off_s`."""
    c = Context(replace(state, belief=state.belief.seen(obs, profile)))
    if c.held_s(DOWN) < off_s:
        return None
    found = find_rest_state(c)
    hangs = found in (RestState.HANGS, RestState.HELD)
    return Rest(found, None if hangs else find_touchdown(c))


def find_touchdown(c: Context) -> Touchdown | None:
    """The newest blow from below, if it may be a touchdown; None if there is no such blow.

    The speed is the state estimate's where that is believed, else the dead reckoning's."""
    b = c.belief
    tel, imu, reckoning = c.telemetry, b.imu, b.reckoning
    blow = imu.blow
    if c.state.phase is Phase.PERCHED or min(tel.t_s, imu.off_s) - blow.t_s > TOUCHDOWN_WITHIN_S:
        return None
    higher = blow.z_m - tel.position_m[2] > SAME_HEIGHT_M
    if b.position_valid and b.dead_reckoned_s is None and higher:
        return None
    reckoned = b.dead_reckoned_s is not None or b.diverged
    speed_mps = -(reckoning.struck_mps if reckoned else blow.estimated_mps)
    return Touchdown(max(0.0, speed_mps), blow.peak_g)


def _reason(state: PlannerState, history: tuple[Event, ...]) -> str:
    why = next((e.reason for e in reversed(history) if e.phase is Phase.LANDING), "")
    told = why and (state.phase is not Phase.ABORTED or Claim.UNCONFIRMED in state.entry.claims)
    return f"{why}; {state.reason}" if told else state.reason
