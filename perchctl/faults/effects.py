"""What a fault does, as values: drawn by the catalogue, laid into a flight by `inject`.

Times are seconds from the fault's beginning; `FOR_EVER` outlasts every flight.
"""

from __future__ import annotations

from dataclasses import dataclass

FOR_EVER = 1e6


@dataclass(frozen=True)
class RadioEffect:
    """What befalls the radio (`perchctl.faults.edges.FaultyRadio`)."""


@dataclass(frozen=True)
class ProgramEffect:
    """What befalls the program's loop (`perchctl.faults.edges.FaultyClock`)."""


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
    """One log block comes no more."""

    block: str
    for_s: float


@dataclass(frozen=True)
class TelemetryDelayed(RadioEffect):
    delay_s: float
    for_s: float


@dataclass(frozen=True)
class CameraFault:
    """`kind`: silent, frozen, snow, dark, covered, lossy, late, out-of-order, mirrored, or sooner:
    late before, as the profile says, and no more; `late_s` of late and sooner."""

    kind: str
    for_s: float
    late_s: float = 0.0


@dataclass(frozen=True)
class EstimateError:
    """Added to the vehicle's state estimate: a step, and a drift."""

    step_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0
    drift_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    for_s: float = FOR_EVER


@dataclass(frozen=True)
class ExternalPositions:
    """The vehicle has no deck but a motion capture; what goes wrong in it is `how`: frozen,
    silent, occluded, swapped, millimetres, mirrored, or late by `late_s`."""

    how: str
    for_s: float
    late_s: float = 0.0


@dataclass(frozen=True)
class DeckSilent:
    """The vehicle has an IMU and a deck that measures absolute positions; the positions end. What
    they corrected until then is an accelerometer that reads `acc_z_mps2` too much along z, since
    turning motors shake it."""

    for_s: float
    acc_z_mps2: float


@dataclass(frozen=True)
class LogReads:
    """A log variable reads this value (None: the one of the moment) whatever is true."""

    names: tuple[str, ...]
    value: float | None
    for_s: float


@dataclass(frozen=True)
class BatterySags:
    """The resting voltage falls at this rate by so much."""

    rate_vps: float
    by_v: float


@dataclass(frozen=True)
class Reboots(RadioEffect):
    """The voltage breaks down and the vehicle starts again: its motors stop, for `boots_s` it hears
    nothing, and its log blocks are gone until the link starts them again."""

    boots_s: float


@dataclass(frozen=True)
class MotorWeak:
    motor: int  # 1 to 4
    strength: float


@dataclass(frozen=True)
class ThrustChanged:
    """All motors give this part of what they gave: another air, another set of propellers."""

    to: float


@dataclass(frozen=True)
class Push:
    """A force on the vehicle, world axes."""

    force_n: tuple[float, float, float]
    for_s: float


@dataclass(frozen=True)
class MagnetHolds:
    """From the start the magnet carries this part of the weight."""

    of_weight: float


@dataclass(frozen=True)
class MagnetLetsGo:
    """So long after the contact, for good."""

    after_s: float


@dataclass(frozen=True)
class Room:
    """What is different from the start; None is as drawn."""

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
    """Ctrl-C at these times; or a closed terminal (`hang_up`)."""

    presses_s: tuple[float, ...]
    hang_up: bool = False


@dataclass(frozen=True)
class Killed(ProgramEffect):
    """The program is gone at once, and sends nothing more."""


@dataclass(frozen=True)
class Suspended(ProgramEffect):
    """Not a line of the program runs."""

    for_s: float


@dataclass(frozen=True)
class Hung(ProgramEffect):
    """The loop's thread is stuck; the program's other threads live."""

    for_s: float


@dataclass(frozen=True)
class Slow(ProgramEffect):
    """Each turn of the loop takes so long."""

    turn_s: float
    for_s: float


@dataclass(frozen=True)
class Raises(ProgramEffect):
    """An exception that the program does not foresee, in the loop's thread."""


@dataclass(frozen=True)
class DiskFull:
    for_s: float


Effect = (
    RadioEffect | ProgramEffect | CameraFault | EstimateError | ExternalPositions | DeckSilent
    | LogReads | BatterySags | MotorWeak | ThrustChanged | Push | MagnetHolds | MagnetLetsGo | Room
    | TargetMoves | Operator | DiskFull
)  # fmt: skip
