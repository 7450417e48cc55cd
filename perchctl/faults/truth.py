"""The ground truth of a flight: samples of the vehicle's state for the oracle, the facts that
determine which outcomes are expected, and the bounds on the vehicle's true motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from perchctl.faults import effects as e
from perchctl.faults.catalogue import CAMERA_GUIDED
from perchctl.faults.oracle import Sample
from perchctl.geometry import GRAVITY_MPS2, rot_z
from perchctl.link import MockLink
from perchctl.mission import Phase
from perchctl.profile import Profile, TargetConfig
from perchctl.sim import (
    CONTROL_PERIOD_S,
    CaptureSettings,
    Scenario,
    SimulatedVehicle,
)
from perchctl.vehicle import LOCKED
from perchctl.vision import CameraModel

MAX_RAW_THRUST = 60000.0
"""The largest raw thrust that is commanded (docs/firmware.md, "Raw thrust")."""
PRESSING_WEIGHT_RATIO = 1.02
"""Multiple of the weight that the rotors must lift to press against the ceiling or the floor."""


class WatchedVehicle(SimulatedVehicle):
    """A simulated vehicle that calls `on_sample` with the time every `e.SAMPLE_S`."""

    def __init__(
        self,
        scenario: Scenario,
        camera: CameraModel,
        target: TargetConfig,
        capture: CaptureSettings | None = None,
    ) -> None:
        super().__init__(scenario, camera, target, capture)
        self.on_sample: Callable[[float], None] = lambda t_s: None
        self._next_s = e.SAMPLE_S

    def advance_to(self, t_s: float) -> None:
        while self.t_s < t_s - CONTROL_PERIOD_S / 2:
            super().advance_to(min(t_s, self._next_s))
            if self.t_s >= self._next_s - CONTROL_PERIOD_S / 2:
                self._next_s += e.SAMPLE_S
                self.on_sample(self.t_s)


def true_sample(vehicle: SimulatedVehicle) -> Sample:
    """The vehicle's true state now; fields that depend on the fault keep their defaults."""
    world, firmware = vehicle.world, vehicle.firmware
    weight_n = vehicle.scenario.mass_kg * GRAVITY_MPS2
    _, qx, qy, _ = world.quaternion
    up_z = 1.0 - 2.0 * (qx * qx + qy * qy)
    target_z_m = vehicle.scenario.ceiling_z_m + vehicle.scenario.target_above_ceiling_m
    ceiling_n, floor = world.push_n_and_on_floor()
    motors_on = max(firmware.motors) > 0.0
    lift_n = world.powertrain.steady_lift_n
    pushing = motors_on and (
        firmware.controller.thrust >= MAX_RAW_THRUST or lift_n >= PRESSING_WEIGHT_RATIO * weight_n
    )
    reserve = world.powertrain.max_balanced_thrust_n() / weight_n - 1.0
    supervisor = firmware.supervisor
    fx, fy, fz = world.fx_mps2, world.fy_mps2, world.fz_mps2
    return Sample(
        vehicle.t_s,
        world.x_m,
        world.y_m,
        world.height_m,
        world.vz_mps,
        up_z,
        math.sqrt(fx * fx + fy * fy + fz * fz) / GRAVITY_MPS2,
        motors_on,
        pushing and (ceiling_n > 0.0 or (floor and up_z < 0.5)),
        floor,
        world.magnet_engaged,
        world.magnet.hold_n / weight_n,
        bool(firmware.supervisor_info & LOCKED),
        supervisor.crashed or supervisor.tumbled,
        math.hypot(world.vx_mps, world.vy_mps),
        thrust_reserve=reserve,
        miss_m=world.gear_miss_m(),
        below_m=target_z_m - world.gear_tip_m()[2],
    )


# --- The facts ---


LEAST_LIFT = 1.02
"""Smallest ratio of lift to weight that keeps a vehicle in the air."""
CUT_S = 1.9
"""Silence above which the firmware cuts the motors, s (2.0 s after the last setpoint)."""
LOCKS_S = 0.1
"""Time from the cut until the lock shows, s. Packets that arrive in this time cannot prevent the
lock."""
LEVELS_S = 0.5
"""Silence after which the firmware levels the vehicle out and replaces the program's setpoint by
its own, s (docs/firmware.md, "When setpoints stop")."""
TOPPLES_S, TOPPLED_UP_Z = 0.3, 0.5
"""Time after a slip within which a vehicle whose motors were stopped cannot have regained control,
s, and the tilt beyond which it has turned over in this time, as the z component of its body's z
axis."""
WATCH_WITHIN_S = 0.1
"""Longest delay until the telemetry shows that a vehicle is hanging, s."""


@dataclass
class Facts:
    """What happened in a flight according to the ground truth; a time is None if the event never
    happened.

    Attributes:
        effects: the fault's effects, which began at `begin_s`.
        silence_lock_s: when the firmware locked the vehicle because no packet had arrived.
        was_landing_onboard: True if the onboard landing was under way when that silence
            began.
        killed_s: when the program was killed.
        rebooted_s: when the vehicle rebooted in the air while its motors were turning.
        stop_s: when the operator's key presses commanded the emergency stop.
        magnet_failed_s: when the magnet failed permanently; `hung_through_watch`: by then, the
            whole weight had hung on the magnet with the motors off for as long as the program
            monitors it.
        slipped_s: when the vehicle first came off the magnet with its motors stopped, at the height
            `slip_height_m`; `toppled`: it turned over within `TOPPLES_S`.
        released_in_silence_s: when the vehicle first came off the magnet after the firmware had
            replaced the setpoint because no packet arrived.
        weak_s: when battery and motors first became unable to lift the weight.
        battery_low_s, battery_low_m: time and height at which the battery's voltage under load was
            first too low.
    """

    effects: tuple[e.Effect, ...] = ()
    begin_s: float | None = None
    silence_lock_s: float | None = None
    was_landing_onboard: bool = False
    killed_s: float | None = None
    rebooted_s: float | None = None
    stop_s: float | None = None
    magnet_failed_s: float | None = None
    hung_through_watch: bool = False
    slipped_s: float | None = None
    slip_height_m: float = 0.0
    toppled: bool = False
    released_in_silence_s: float | None = None
    weak_s: float | None = None
    battery_low_s: float | None = None
    battery_low_m: float = 0.0

    def has_effect(self, act: Callable[..., None]) -> bool:
        return any(effect.func is act for effect in self.effects)


class FactsRecorder(Facts):
    """Collects the facts of a flight from samples of the true state."""

    def __init__(
        self, vehicle: SimulatedVehicle, profile: Profile, effects: tuple[e.Effect, ...] = ()
    ) -> None:
        super().__init__(effects)
        complete = profile.planner.complete
        self._watch_s = complete.hang_s + complete.watch_s - WATCH_WITHIN_S
        self._min_load_v = profile.safety.min_load_v
        self._vehicle = vehicle
        self._silent_s: float | None = None  # start of the current silence
        self._heard_s = -math.inf  # end of the newest silence that may end in a lock
        self._landed_alone = self._begun = False
        self._hangs_s: float | None = None  # when the whole weight began to hang on the magnet
        self._before: Sample | None = None

    def update(self, sample: Sample) -> None:
        """Record the next sample. Once the fault has begun, the caller must have set `begin_s`
        before this call."""
        before = self._before
        self._note_silence(sample)
        self._note_hanging(sample)
        if self.begin_s is not None:
            flew = before is not None and before.motors_on and not before.on_floor
            if not self._begun and flew and self.has_effect(e.reboots):
                self.rebooted_s = self.begin_s
            self._begun = True
            self._note_power(sample)
        self._before = sample

    def _note_silence(self, s: Sample) -> None:
        long = self._silent_s is not None and s.t_s - self._silent_s >= CUT_S
        self.was_landing_onboard = self.was_landing_onboard or (long and self._landed_alone)
        locks = s.locked and not (self._before and self._before.locked)
        ordered = self._vehicle.firmware.supervisor.emergency  # locked by a command
        late = s.t_s - self._heard_s <= LOCKS_S and not ordered
        if locks and (long or late) and self.silence_lock_s is None:
            self.silence_lock_s = s.t_s
        if s.uplink:
            self._heard_s = s.t_s if long else self._heard_s
            self._silent_s = None
        elif self._silent_s is None:
            self._silent_s = s.t_s
            self._landed_alone = self._vehicle.firmware.planner.active

    def _note_hanging(self, s: Sample) -> None:
        before = self._before
        if self.magnet_failed_s is None and self._vehicle.world.magnet.let_go:
            self.magnet_failed_s = s.t_s
            self.hung_through_watch = (
                self._hangs_s is not None and s.t_s - self._hangs_s >= self._watch_s
            )
        came_off = before is not None and before.hanging and not s.hanging
        silent = self._silent_s is not None and s.t_s - self._silent_s >= LEVELS_S
        replaced = silent and not self._landed_alone and s.motors_on  # the program's setpoint
        if came_off and replaced and self.released_in_silence_s is None:
            self.released_in_silence_s = s.t_s
        if came_off and not s.motors_on and self.slipped_s is None:
            self.slipped_s, self.slip_height_m = s.t_s, s.height_m
        if self.slipped_s is not None and s.t_s - self.slipped_s <= TOPPLES_S:
            self.toppled = self.toppled or s.body_up_z < TOPPLED_UP_Z
        if s.motors_on or not s.hanging:
            self._hangs_s = None
        elif self._hangs_s is None:
            self._hangs_s = s.t_s

    def _note_power(self, s: Sample) -> None:
        """Record when four times the thrust of the weakest motor first fails to lift the weight,
        and when the battery's voltage under load is first too low."""
        world = self._vehicle.world
        if self.weak_s is None and 1.0 + s.thrust_reserve < LEAST_LIFT:
            self.weak_s = s.t_s
        if self.battery_low_s is None and world.battery_v < self._min_load_v:
            self.battery_low_s, self.battery_low_m = s.t_s, s.height_m


# --- Requirements on a flight ---


Place = tuple[float, float]
"""A position on the floor (x, y) in world axes, m."""

UNDER_TARGET = frozenset({Phase.ASCEND, Phase.PERCH, Phase.COMPLETE, Phase.HOVER})
STEERED_BY_TARGET = UNDER_TARGET | {Phase.ESTIMATE, Phase.ALIGN}
TERMINALS = frozenset({Phase.LANDING, Phase.PERCHED, Phase.LANDED, Phase.ABORTED})
GUIDED_BY_CAMERA = frozenset(CAMERA_GUIDED) | {Phase.HOVER}
FREE_AIR = GUIDED_BY_CAMERA | {Phase.APPROACH}
NO_PICTURE = ("silent", "frozen", "snow")
"""The camera faults that leave no usable image. During a fault in `NO_SIGHT`, no target can be
seen."""
# without "dark", because a nearby target is found even in a dark image
NO_SIGHT = (*NO_PICTURE, "covered")
NO_POSITION = ("silent", "frozen", "occluded", "swapped", "millimetres")
LASTS_S = 0.5
"""If a loss ends within this time after its limit, the vehicle need not have landed, s."""
REACTION_S = 1.0
"""Longest time from the profile's limit to the descent, s: the delay of one loop iteration, and the
time for the thrust to decrease."""
WATCHED_S, SUNK_M = 2.0, 0.15
"""Time after `REACTION_S`, s, and the height that the vehicle must have lost by then, m; losing
this height takes less than a third of the landing speed."""
COMING_DOWN_MPS = 0.1
"""Sink rate above which the vehicle counts as coming down in any case, m/s."""
HANDED_OVER_M = 0.3
"""Height at which a landing is handed over to the firmware and slows down, m."""


class PositionBound:
    """The horizontal region in which the vehicle must be in each phase. During take-off, the region
    is the start (or `planner.approach_xy_m`); during search, estimate, alignment and recovery, the
    line between start and target; during ascent, press and completion, the place under a target.
    Once a landing begins or the mission ends, it is the point of the region that was nearest to the
    vehicle at that time.

    A target that looks like the vehicle's own also counts as a target.
    """

    def __init__(self, scenario: Scenario, profile: Profile) -> None:
        approach = profile.planner.approach_xy_m
        self._starts: list[Place] = [] if approach is None else [approach]
        self._targets = list(target_places(scenario))
        self._phase: Phase | None = None
        self._down_at: Place | None = None

    def add_target(self, place: Place) -> None:
        if place not in self._targets:
            self._targets.append(place)

    def note_phase(self, phase: Phase | None, place: Place) -> None:
        """Record the program's phase and the vehicle's true position; the first position is the
        start."""
        if self._phase is None:
            self._starts.insert(0, place)
        if phase in TERMINALS and self._down_at is None:
            self._down_at = min(self._nearest(place), key=lambda spot: math.dist(spot, place))
        self._phase = phase or Phase.APPROACH

    def astray_m(self, place: Place) -> float:
        """The distance from `place` to the region in which the vehicle must be."""
        return min(math.dist(spot, place) for spot in self._nearest(place))

    def _nearest(self, place: Place) -> list[Place]:
        """The point nearest to the vehicle on each line where it may be."""
        if self._down_at is not None:
            return [self._down_at]
        if self._phase in (None, Phase.APPROACH):
            ends = self._starts
        elif self._phase in UNDER_TARGET and self._targets:
            return list(self._targets)
        else:
            ends = [*self._starts, *self._targets]
        return [_nearest_between(a, b, place) for a in ends for b in ends]


def _nearest_between(a: Place, b: Place, place: Place) -> Place:
    """The point nearest to `place` on the line from `a` to `b`."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    long_m2 = dx * dx + dy * dy
    if long_m2 == 0.0:
        return a
    part = ((place[0] - a[0]) * dx + (place[1] - a[1]) * dy) / long_m2
    part = min(1.0, max(0.0, part))
    return a[0] + part * dx, a[1] + part * dy


def target_places(scenario: Scenario) -> list[Place]:
    """The positions of the vehicle's target and of neighbouring targets that look the same; none
    without a target."""
    if scenario.no_target:
        return []
    x_m, y_m = scenario.target_xy_m
    turn = rot_z(scenario.target_yaw_rad)
    found = [(x_m, y_m)]
    for neighbour in scenario.neighbours:
        if neighbour.large_id is None:
            dx, dy, _ = turn @ (*neighbour.xy_m, 0.0)
            found.append((x_m + float(dx), y_m + float(dy)))
    return found


class UndetectedDrift:
    """How far (m) a fault may move the vehicle sideways without any sensor detecting it.

    A drift counts while the vehicle does not steer by a visible target. A force counts while it
    acts and the target, as the positioning system, is out of view. A step does not count, because
    it can be detected.
    """

    def __init__(
        self, effects: tuple[e.Effect, ...], scenario: Scenario, *, by_target: bool
    ) -> None:
        self._slides = [
            (math.hypot(*effect.keywords.get("drift_mps", (0.0, 0.0, 0.0))[:2]), _for_s(effect))
            for effect in effects
            if effect.func is e.estimate_error
        ]
        self._pushes = [
            (math.hypot(*effect.keywords["force_n"][:2]) / scenario.mass_kg, _for_s(effect))
            for effect in effects
            if effect.func is e.push and by_target
        ]
        self._slid_m = self._fault_s = 0.0

    def update_drift_m(self, fault_s: float, phase: Phase | None) -> float:
        """The possible drift, m, `fault_s` after the fault began. Must be called with increasing
        times."""
        before_s, self._fault_s = self._fault_s, fault_s
        if phase in UNDER_TARGET:
            self._slid_m = 0.0
        elif phase not in STEERED_BY_TARGET:
            for speed_mps, for_s in self._slides:
                self._slid_m += speed_mps * (min(fault_s, for_s) - min(before_s, for_s))
        return self._slid_m + sum(
            0.5 * acc_mps2 * min(fault_s, for_s) ** 2 for acc_mps2, for_s in self._pushes
        )


class DescentBound:
    """Determines when the vehicle must descend: at once after the operator's command or an
    exception, otherwise once the fault has lasted longer than the profile's waiting time."""

    def __init__(self, effects: tuple[e.Effect, ...], profile: Profile) -> None:
        self._effects, self._profile = effects, profile
        self._due_s: float | None = None  # None: the fault has not begun
        self._from_m: float | None = None  # the vehicle's height when the descent became due

    def begin(self, t_s: float, phase: Phase | None) -> None:
        """Record when the fault began, and the program's phase at that time, None before the
        mission's first tick. Further calls do nothing."""
        if self._due_s is None:
            limits_s = [landing_due_s(effect, self._profile, phase) for effect in self._effects]
            self._due_s = t_s + min(limits_s, default=math.inf)

    def is_overdue(
        self,
        t_s: float,
        height_m: float,
        vz_mps: float,
        *,
        touching: bool,
        uplink: bool,
        lands: bool = False,
    ) -> bool:
        """True if the vehicle should have descended by now but has not.

        A vehicle that touches the ceiling in time (`touching`) may hang there instead. As long as
        there is no `uplink`, the time allowed for descending keeps restarting. `lands`: the onboard
        landing is active, which counts as descending unless the vehicle climbs.
        """
        if self._due_s is None:
            return False
        if touching and t_s < self._due_s + REACTION_S:
            self._due_s = math.inf
        if not uplink:
            self._due_s, self._from_m = max(self._due_s, t_s), None
        if t_s < self._due_s:
            return False
        if self._from_m is None:
            self._from_m = height_m
        late = t_s >= self._due_s + REACTION_S + WATCHED_S
        comes_down = vz_mps < -COMING_DOWN_MPS or height_m <= max(
            HANDED_OVER_M, self._from_m - SUNK_M
        )
        begins = lands and height_m <= self._from_m + SUNK_M
        return late and not (comes_down or begins)


def _for_s(effect: e.Effect) -> float:
    return float(effect.keywords.get("for_s", e.FOR_EVER))


def landing_due_s(effect: e.Effect, profile: Profile, phase: Phase | None) -> float:
    """The time, s, from an effect's beginning in `phase` until the program must land; infinite if
    it need not land. `phase` is None before the mission's first tick: the effect then lasts into
    the take-off, but a loop that stands still does not begin one until it runs again."""
    safety, values, limit_s = profile.safety, effect.keywords, math.inf
    if phase is None:
        if effect.func in (e.suspended, e.hung):
            return math.inf
        phase = Phase.APPROACH
    if effect.func is e.operator:
        limit_s = min(values["presses_s"])
    elif effect.func is e.parent_gone:
        limit_s = values["noticed_s"]
    elif effect.func is e.raises:
        limit_s = 0.0
    elif effect.func in (e.suspended, e.hung):
        limit_s = safety.loop_late_land_s
    elif effect.func is e.radio_loss:
        silent = values.get("down") in ("all", *MockLink.FAST_BLOCKS)
        if silent and values.get("delay_s", math.inf) > safety.telemetry_land_s:
            limit_s = safety.telemetry_land_s
    elif effect.func is e.camera_fault:
        if values["kind"] in NO_PICTURE and phase in GUIDED_BY_CAMERA:
            limit_s = safety.camera_land_s
        if values["kind"] in NO_SIGHT and profile.positioning.source.is_target:
            limit_s = min(limit_s, profile.positioning.land_s)
    elif effect.func is e.deck_silent or values.get("how") in NO_POSITION:
        limit_s = profile.positioning.land_s
    flown = phase in FREE_AIR and _for_s(effect) > limit_s + LASTS_S
    return limit_s if flown else math.inf
