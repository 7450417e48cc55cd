"""The interface between a flight and a vehicle's link."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Protocol

from perchctl.errors import InvalidValue
from perchctl.extensions import has_extension_form
from perchctl.mission import SentCommand
from perchctl.vehicle import Command, ExternalPosition, Telemetry

LANDING_WAIT_S = 6.0
"""Time for which a closing link waits for a vehicle that is still flying, s."""
SentCallback = Callable[[SentCommand], None]
"""Called with each command that a link sends in the loop's place; neither waits nor raises."""


def ignore_sent(sent: SentCommand) -> None:
    """A `SentCallback` that does nothing."""
    return


Guard = Callable[[float, Telemetry | None, Sequence[Telemetry]], Command | None]
"""Returns the command that the link must send in the loop's place; this is nearly always None. The
guard's arguments are the time, the newest telemetry, and the samples that the loop has not taken
yet, oldest first. The guard is called about every 50 ms, in a thread of the link if it has one, but
not while a command is waiting to be sent."""


class Link(Protocol):
    """A vehicle, either simulated in lockstep or connected through cflib.

    All methods but `send_external` are called from the flight loop's thread. These methods raise
    ConnectionFailed, NotFound or TimedOut from `perchctl.errors`.
    """

    def connect(self) -> None:
        """Connect, check the firmware, set parameters and unlock the thrust, with a timeout. This
        does not arm the vehicle: a vehicle that does not arm itself receives `Arm` just before
        take-off."""

    def decks(self) -> tuple[str, ...]:
        """Return the decks that the connected vehicle found at boot, by the firmware's names."""

    def telemetry(self) -> list[Telemetry]:
        """Return the samples that arrived since the last call, oldest first."""

    def send(self, command: Command) -> None:
        """Send one command to the vehicle. Blocks only briefly."""

    def send_external(self, place: ExternalPosition) -> bool:
        """Send an external position to the vehicle, at once or not at all. The position is never
        queued, and no exception is raised. Returns True if it was sent. Called from the thread of
        the position feed."""

    def problem(self, now_s: float) -> str | None:
        """Return None while the link works, otherwise one sentence with the cause."""

    def set_guard(self, guard: Guard, on_sent: SentCallback = ignore_sent) -> None:
        """Call `guard` regularly from now on, until the link is closed.

        `on_sent` is called with each command that the link has sent in the loop's place: the
        guard's commands, commands repeated after a lost link, and the farewell. `on_sent` is called
        from the link's own thread if it has one.
        """

    def close(self) -> None:
        """Close the link after waiting, with a timeout, until the vehicle is no longer flying. A
        vehicle on the ground that does not arm itself is disarmed, however the session ended."""


class VehicleLink(Protocol):
    """Your own link. perchctl calls its class with the loop's clock, a function that returns
    seconds, and the profile's section `link`.

    `telemetry` and `problem` are called in one thread, 200 times a second, and `send` in another
    one (after a hang, in a new one). An exception in `telemetry` or `problem`, exceptions in `send`
    for 0.5 s, or a call longer than 0.5 s count as a lost link: perchctl continues to send, and
    lands the vehicle.
    """

    def connect(self) -> None:
        """Connect to a vehicle on the ground and prepare it for a flight, with a timeout. Must not
        spin a motor and therefore must not arm the vehicle, because nobody has confirmed the flight
        yet. perchctl refuses a vehicle that is armed without `AUTO_ARM`, or that sends no telemetry
        within 3 s. Raises one of `perchctl.errors`, such as ConnectionFailed."""

    def decks(self) -> tuple[str, ...]:
        """Return the decks that measure the vehicle's position, by the firmware's names (bcFlow2,
        ...)."""

    def telemetry(self) -> list[Telemetry]:
        """Return the samples (`perchctl.vehicle.Telemetry`: SI, right-handed, `t_s` on the loop's
        clock) that arrived since the last call, oldest first; ideally 100 per second.

        Take-off also requires `battery_v`, `velocity_variance_m2ps2` and `height_variance_m2` (with
        a Lighthouse or Loco deck, `position_variance_m2`); a profile lists values that are never
        reported in `link.unreported`.
        """

    def send(self, command: Command) -> None:
        """Send one command of `perchctl.vehicle` to the vehicle, about 50 times a second.
        If no further command arrives, the vehicle must level out by itself after 0.5 s and stop
        after 2 s.

        `Arm(True)` is sent just before take-off, if the telemetry's bits are `CAN_ARM` without
        `AUTO_ARM` and `CAN_FLY`; `Arm(False)` after a session, on the ground, if they are `ARMED`
        without `AUTO_ARM`.
        """

    def problem(self, now_s: float) -> str | None:
        """Return None while the link works, otherwise one sentence with the cause."""

    def close(self) -> None:
        """Disconnect; called when the vehicle is no longer flying, after 6 s at the latest."""


# --- The forms of a vehicle's URI ---


USUAL_ADDRESS = "E7E7E7E7E7"
"""Default radio address of a Crazyflie."""
_USUAL = ("2", "2M", USUAL_ADDRESS)  # default channel, rate and address of a radio URI
_CHANNEL, _RATE, _ADDRESS = "(12[0-5]|1[01][0-9]|0?[0-9]{1,2})", "(250K|1M|2M)", "[0-9A-Fa-f]{1,10}"
FORMS = {
    "sim": "",
    "radio": rf"([0-9]+|[0-9A-Fa-f]{{10}})(/{_CHANNEL}(/{_RATE}(/{_ADDRESS})?)?)?(\?.+)?",
    "usb": r"\d+",
    "udp": r"[^/:\s]+:0*[1-9]\d{0,4}",
    "hub": rf"127\.0\.0\.1:[1-9]\d{{0,4}}/{_CHANNEL}/{_RATE}/{_ADDRESS}"
    r"\?key=[0-9a-f]{16}",
}
"""Regular expressions of the URIs, by scheme. `hub` is a radio vehicle behind a `RadioHub`, which
makes these URIs; users never type one."""
EXAMPLES = (
    "sim://, radio://0/80/2M/E7E7E7E7E7 (channel 0 to 125; 250K, 1M or 2M; an address of at "
    "most ten hex digits), usb://0, udp://127.0.0.1:19850 (port 1 to 65535)"
)

UDEV_HELP = """\
Write these lines to /etc/udev/rules.d/99-bitcraze.rules:
  # Crazyradio (PA and 2.0)
  SUBSYSTEM=="usb", ATTRS{idVendor}=="1915", ATTRS{idProduct}=="7777", MODE="0664", GROUP="plugdev"
  # Crazyradio bootloader
  SUBSYSTEM=="usb", ATTRS{idVendor}=="1915", ATTRS{idProduct}=="0101", MODE="0664", GROUP="plugdev"
  # Crazyflie over USB
  SUBSYSTEM=="usb", ATTRS{idVendor}=="0483", ATTRS{idProduct}=="5740", MODE="0664", GROUP="plugdev"
then run:
  sudo groupadd -f plugdev
  sudo usermod -a -G plugdev $USER
  sudo udevadm control --reload-rules && sudo udevadm trigger
log in again, and plug the radio or the vehicle in again."""


def is_own_uri(uri: str) -> bool:
    """True for your own link, ``my_module:MyLink``; a scheme such as ``radio`` is not a module."""
    return has_extension_form(uri, FORMS)


def check_uri(uri: str) -> str:
    """Return the URI's scheme. Raises InvalidValue if the URI does not identify a vehicle."""
    scheme, _, rest = uri.partition("://")
    fits = "://" in uri and scheme in FORMS and re.fullmatch(FORMS[scheme], rest)
    if not fits or (scheme == "udp" and int(rest.rpartition(":")[2]) > 65535):
        raise InvalidValue(f"{uri!r} is not the URI of a vehicle; examples: {EXAMPLES}")
    return scheme


def vehicle_uri(uri: str) -> str:
    """Return a string that is the same for all URIs of a vehicle: the URI without dongle and
    options, in one letter case."""
    scheme, _, rest = uri.partition("?")[0].partition("://")
    scheme = scheme.lower()
    if scheme == "radio":
        given = [part for part in rest.split("/")[1:4] if part]
        channel, rate, address = (*given, *_USUAL[len(given) :])
        return f"radio/{int(channel)}/{rate.upper()}/{address.upper().zfill(len(USUAL_ADDRESS))}"
    return f"{scheme}/{rest.lower().replace('localhost:', '127.0.0.1:')}"
