"""What a fault does, as values: drawn by the catalogue, laid into a flight by `inject`.

Times are seconds from the fault's beginning; `FOR_EVER` outlasts every flight.
"""

from __future__ import annotations

from dataclasses import dataclass

FOR_EVER = 1e6


@dataclass(frozen=True)
class RadioEffect:
    """An effect on the radio (`perchctl.faults.edges.FaultyRadio`)."""


@dataclass(frozen=True)
class ProgramEffect:
    """An effect on the program's loop (`perchctl.faults.edges.FaultyClock`)."""


@dataclass(frozen=True)
class Silence(RadioEffect):
    """The radio carries nothing, up, down or both."""

    for_s: float
    up: bool
    down: bool


@dataclass(frozen=True)
class PacketLost(RadioEffect):
    """The next `count` packets of an order are lost (`ORDERS` of `perchctl.faults.edges`)."""

    order: str
    count: int


@dataclass(frozen=True)
class PacketTwice(RadioEffect):
    """The next packet of an order arrives twice."""

    order: str


@dataclass(frozen=True)
class BlockDead(RadioEffect):
    """One log block stops arriving."""

    block: str
    for_s: float


@dataclass(frozen=True)
class TelemetryDelayed(RadioEffect):
    delay_s: float
    for_s: float


@dataclass(frozen=True)
class CameraFault:
    """The camera's pictures are spoilt. `kind` is silent, frozen, snow, dark, covered, lossy,
    late, out-of-order, mirrored or sooner (pictures that were late, as the profile expects, no
    longer are). `late_s` belongs to late and sooner."""

    kind: str
    for_s: float
    late_s: float = 0.0


@dataclass(frozen=True)
class EstimateError:
    """A step and a drift are added to the vehicle's state estimate."""

    step_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0
    drift_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    for_s: float = FOR_EVER


@dataclass(frozen=True)
class ExternalPositions:
    """A vehicle without a deck flies by a motion capture that fails. `how` is frozen, silent,
    occluded, swapped, millimetres, mirrored, or late by `late_s`."""

    how: str
    for_s: float
    late_s: float = 0.0


@dataclass(frozen=True)
class DeckSilent:
    """The absolute positions of the vehicle's deck stop. Until then they corrected an
    accelerometer that reads `acc_z_mps2` too much along z, because the motors shake it."""

    for_s: float
    acc_z_mps2: float


@dataclass(frozen=True)
class LogReads:
    """Log variables report `value` (None: their value of that moment) whatever is true."""

    names: tuple[str, ...]
    value: float | None
    for_s: float


@dataclass(frozen=True)
class BatterySags:
    """The battery's resting voltage falls by `by_v` at this rate."""

    rate_vps: float
    by_v: float


@dataclass(frozen=True)
class Reboots(RadioEffect):
    """The vehicle reboots after a voltage drop: its motors stop, it receives nothing for
    `boots_s`, and its log blocks are gone until the link starts them again."""

    boots_s: float


@dataclass(frozen=True)
class MotorWeak:
    motor: int  # 1 to 4
    strength: float


@dataclass(frozen=True)
class ThrustChanged:
    """All motors give this part of their thrust, as with other propellers."""

    to: float


@dataclass(frozen=True)
class Push:
    """A force in world axes acts on the vehicle."""

    force_n: tuple[float, float, float]
    for_s: float


@dataclass(frozen=True)
class MagnetHolds:
    """The magnet holds this part of the weight from the start."""

    of_weight: float


@dataclass(frozen=True)
class MagnetLetsGo:
    """The magnet lets go for good, so long after the contact."""

    after_s: float


@dataclass(frozen=True)
class Room:
    """The room differs from the scenario from the start; None keeps the drawn value."""

    ceiling_z_m: float | None = None
    no_target: bool = False
    target_above_ceiling_m: float = 0.0
    second_target_m: tuple[float, float] | None = None
    mount_turned_deg: float = 0.0


@dataclass(frozen=True)
class TargetMoves:
    by_m: tuple[float, float]


@dataclass(frozen=True)
class Operator:
    """The operator presses Ctrl-C at these times, or closes the terminal (`hang_up`)."""

    presses_s: tuple[float, ...]
    hang_up: bool = False


@dataclass(frozen=True)
class Killed(ProgramEffect):
    """The program is killed and sends nothing more."""


@dataclass(frozen=True)
class Suspended(ProgramEffect):
    """The whole program is suspended."""

    for_s: float


@dataclass(frozen=True)
class Hung(ProgramEffect):
    """The loop's thread is stuck; the program's other threads live."""

    for_s: float


@dataclass(frozen=True)
class Slow(ProgramEffect):
    """Each tick of the loop takes `turn_s`."""

    turn_s: float
    for_s: float


@dataclass(frozen=True)
class Raises(ProgramEffect):
    """An exception that the program does not foresee is raised in the loop's thread."""


@dataclass(frozen=True)
class DiskFull:
    for_s: float


Effect = (
    RadioEffect | ProgramEffect | CameraFault | EstimateError | ExternalPositions | DeckSilent
    | LogReads | BatterySags | MotorWeak | ThrustChanged | Push | MagnetHolds | MagnetLetsGo | Room
    | TargetMoves | Operator | DiskFull
)  # fmt: skip
