"""The profile's section on the source of the state estimate's position."""

from __future__ import annotations

from enum import Enum
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, WithJsonSchema, field_validator, model_validator

from perchctl.extensions import PATTERN, has_extension_form
from perchctl.profile.base import BodyVector3, Section, Vector3, key

SPARE_S = 0.02
"""Tolerance of the rate, because frames do not arrive exactly on time."""
MOST_CAPTURE_LATENCY_S = 0.04
"""Largest delay of a position, s, because the vehicle treats each position as its present one. With
positions 40 ms late, the vehicle perches within 2 mm. At 50 ms, the vehicle may oscillate for a
minute and then land (tests/flight/test_capture_flights.py)."""
_HOST = r"^([^\s:/?#@]+(:[1-9][0-9]{0,4})?)?$"


def _known_system(system: str) -> str:
    if system in SYSTEMS or has_extension_form(system, SYSTEMS):
        return system
    known, colon, _host = system.partition(":")
    if colon and known.lower() in SYSTEMS:
        raise ValueError(
            f"{system!r} is {known.lower()} with a host: write system and host as two keys"
        )
    raise ValueError(
        f"{system!r} is unknown; allowed are {', '.join(SYSTEMS)}, or my_module:MySource"
    )


SYSTEMS = ("vicon", "optitrack", "qualisys", "vrpn")
System = Annotated[
    str,
    AfterValidator(_known_system),
    WithJsonSchema({"anyOf": [{"enum": list(SYSTEMS)}, {"type": "string", "pattern": PATTERN}]}),
]
_DECKS = ("lighthouse", "flow", "loco", "lps", "uwb")
BY_TARGET = {"rate_hz": 30.0, "position_sigma_m": 0.02, "hold_s": 0.5, "land_s": 1.5}
"""Other defaults for positions from images, which arrive late and with gaps."""


class PositionSource(Enum):
    """The source of the position, with the properties on which other code depends."""

    DECK = "deck"
    MOCAP = "mocap"
    TARGET = "target"

    @property
    def is_deck(self) -> bool:
        """True if the vehicle's own decks measure the position: nothing has to be sent, and the
        position of a Flow deck drifts."""
        return self is PositionSource.DECK

    @property
    def is_mocap(self) -> bool:
        """True if cameras in the room measure the position, in their own axes and independently of
        what the vehicle sees."""
        return self is PositionSource.MOCAP

    @property
    def is_target(self) -> bool:
        """True if the vehicle's camera measures the position from the target: late, and only while
        the target is in view."""
        return self is PositionSource.TARGET


_SOURCES = {source.value: source for source in PositionSource}
"""Position sources by name. Every tick looks up a source here, because calling
`PositionSource(name)` would take ten times as long."""


class PositioningConfig(Section):
    """The source of the vehicle's position.

    `deck`: the vehicle's own decks measure the position. `mocap`: a motion-capture system measures
    a rigid body on the vehicle, and perchctl sends its position to the vehicle. `target`: perchctl
    sends the position that the camera measures from the printed target.

    The rigid body's frame, as the system defines it, is rotated by `body_rpy_deg` and has its
    origin at `body_position_m`, both in the vehicle's body axes.
    """

    by: Literal["deck", "mocap", "target"] = key("deck", "source of the vehicle's position")
    system: System = key(
        "vicon", "motion-capture system, or your own source, as `my_module:MySource`"
    )
    host: str = key(
        "", "host of the motion-capture system, as `NAME` or `NAME:PORT`", pattern=_HOST
    )
    body: str = key(
        "crazyflie", "name of the vehicle's rigid body in the motion-capture system", min_length=1
    )
    body_rpy_deg: Vector3 = key(
        (0.0, 0.0, 0.0),
        "rotation of the rigid body relative to the vehicle's axes: roll, pitch, yaw",
    )
    body_position_m: BodyVector3 = key(
        (0.0, 0.0, 0.0), "position of the rigid body's origin in the vehicle's axes"
    )
    send: Literal["position", "pose"] = key(
        "position", "what to send: the position only, or position and attitude"
    )
    rate_hz: float = key(100.0, "maximum rate at which positions are sent", ge=10, le=100)
    latency_s: float = key(
        0.01,
        "time from the exposure of the motion-capture cameras to the arrival of the frame, as "
        "accurately as you know it",
        ge=0,
        le=MOST_CAPTURE_LATENCY_S,
    )
    position_sigma_m: float = key(
        0.005,
        "standard deviation that the vehicle assumes for positions (`locSrv.extPosStdDev`)",
        gt=0,
        le=0.2,
    )
    attitude_sigma_rad: ClassVar[float] = 0.05  # the error that the vehicle assumes
    hold_s: float = key(
        0.15,
        "time without a fresh position after which the vehicle holds its position",
        gt=0,
        le=0.5,
    )
    land_s: float = key(
        0.7, "time without a fresh position after which the vehicle lands", gt=0, le=2
    )
    connect_timeout_s: float = key(
        5.0, "time limit for the first frame from the motion-capture system", gt=0, le=60
    )

    decks: tuple[str, ...] = key(
        (), "positioning decks with your own drivers, named as `check` shows them"
    )

    @staticmethod
    def deck_note(name: object) -> str:
        """What to write instead, for a message about the unknown position source `name`; empty
        unless it is the name of a positioning deck."""
        is_deck = str(name).lower().startswith(_DECKS)
        return "; write deck: perchctl finds out which decks the vehicle has" if is_deck else ""

    @property
    def source(self) -> PositionSource:
        """The method as a `PositionSource`."""
        return _SOURCES[self.by]

    @property
    def label(self) -> str:
        """Name of the position source in messages."""
        if self.source.is_target:
            return "the view of the target"
        return f"motion capture at {self.system}:{self.host}".rstrip(":")

    def with_method(self, by: str) -> dict[str, Any]:
        """Return the section's values with another position source (`by`). Keys of the previous
        source are dropped, except `decks`. If motion capture replaces a deck, all keys are kept,
        because a profile for a deck may contain the keys for motion capture as well."""
        if by == self.by:
            return self.model_dump()
        kept = self.model_dump() if (self.by, by) == ("deck", "mocap") else {"decks": self.decks}
        return {**kept, "by": by}

    @field_validator("by", mode="before")
    @classmethod
    def _names_no_deck(cls, by: object) -> object:
        if note := cls.deck_note(by):
            raise ValueError(f"found {by!r}; allowed are {', '.join(_SOURCES)}{note}")
        return by

    @model_validator(mode="before")
    @classmethod
    def _one_word(cls, values: Any) -> Any:
        """Read `positioning: mocap` as the key `by`, and keep the rest unchanged."""
        values = {"by": values} if isinstance(values, str) else values
        if isinstance(values, dict) and values.get("by") == "target":
            return {**BY_TARGET, **values}
        return values

    @model_validator(mode="after")
    def _is_meant(self) -> PositioningConfig:
        """Reject keys for motion capture if decks measure the position, since the flight would not
        use them. (The profile in a log contains every key, including `by`.)"""
        given = self.model_fields_set - {"decks"}
        if self.by == "deck" and (self.host if "by" in given else given):
            raise ValueError(
                "there are keys for motion capture, but positioning.by is deck: write by: mocap, "
                "or only positioning: deck"
            )
        return self

    @model_validator(mode="after")
    def _fits(self) -> PositioningConfig:
        if self.hold_s <= self.latency_s + 1.0 / self.rate_hz + SPARE_S:
            raise ValueError(
                f"hold_s ({self.hold_s:g}) must exceed the sum of latency_s ({self.latency_s:g}) "
                f"and one period of rate_hz ({self.rate_hz:g}) by more than {SPARE_S:g} s: "
                "otherwise a position is stale before the next one arrives"
            )
        if self.land_s <= self.hold_s:
            raise ValueError(
                f"land_s ({self.land_s:g}) must be longer than hold_s ({self.hold_s:g})"
            )
        return self
