"""The forms of a vehicle's URI, and what to do without rights to the radio."""

from __future__ import annotations

import re

from perchctl.errors import InvalidValue

FORMS = {
    "sim": r"sim://",
    "radio": r"radio://([0-9]+|[0-9A-Fa-f]{10})((?:/[^/?\s]*){0,3})(\?.+)?",
    "usb": r"usb://\d+",
    "udp": r"udp://[^/:\s]+:\d{1,5}",
    "tcp": r"tcp://[^/:\s]+:\d{1,5}",
    "serial": r"serial://.+",
}
MOST_CHANNEL, RATES = 125, ("250K", "1M", "2M")
ADDRESS_DIGITS = 10
_USUAL = ("2", "2M", "E7E7E7E7E7")  # channel, rate and address of a radio's URI that names none
EXAMPLES = "sim://, radio://0/80/2M/E7E7E7E7E7, usb://0, udp://127.0.0.1:19850"

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


def check_uri(uri: str) -> str:
    """The URI's scheme. Raises InvalidValue, which names what is allowed."""
    scheme = uri.split("://", 1)[0]
    form = re.fullmatch(FORMS[scheme], uri) if scheme in FORMS else None
    if form is None:
        raise InvalidValue(f"URI {uri!r} is not one of a vehicle; examples: {EXAMPLES}")
    wrong = _wrong_with_radio(form[2].split("/")[1:]) if scheme == "radio" else ""
    if scheme in ("udp", "tcp") and not 0 < int(uri.rpartition(":")[2]) <= 65535:
        wrong = "has no port of 1 to 65535"
    if wrong:
        raise InvalidValue(f"URI {uri!r} {wrong}; examples: {EXAMPLES}")
    return scheme


def _wrong_with_radio(parts: list[str]) -> str:
    """Of channel, rate and address, as far as they are given; empty where all are right."""
    channel, rate, address, *_ = [*parts, None, None, None]
    if channel is not None and not _is_channel(channel):
        return f"has channel {channel!r}; allowed are 0 to {MOST_CHANNEL}"
    if rate is not None and rate not in RATES:
        return f"has data rate {rate!r}; allowed are {', '.join(RATES)}"
    if address is not None and not re.fullmatch(f"[0-9A-Fa-f]{{{ADDRESS_DIGITS}}}", address):
        return f"has address {address!r}; needed are ten hex digits"
    return ""


def _is_channel(text: str) -> bool:
    return re.fullmatch("[0-9]{1,3}", text) is not None and int(text) <= MOST_CHANNEL


def with_whole_address(uri: str) -> str:
    """A radio's URI as cflib finds it, which leaves an address's zeros in front away."""
    return re.sub(
        r"^(radio://[^/]+/[^/]+/[^/]+/)([0-9A-Fa-f]+)",
        lambda found: found[1] + found[2].zfill(ADDRESS_DIGITS),
        uri,
    )


def vehicle_uri(uri: str) -> str:
    """The URI without what does not tell vehicles apart: a radio's dongle, case, options."""
    scheme, _, rest = uri.partition("?")[0].partition("://")
    scheme = scheme.lower()
    if scheme == "radio":
        given = [part for part in rest.split("/")[1:4] if part]
        channel, rate, address = (*given, *_USUAL[len(given) :])
        return f"radio/{int(channel)}/{rate.upper()}/{address.upper().zfill(len(_USUAL[2]))}"
    if scheme != "serial":  # whose place is a file, and its case tells
        rest = rest.lower()
    return f"{scheme}/{re.sub('^localhost(?=:|$)', '127.0.0.1', rest)}"
