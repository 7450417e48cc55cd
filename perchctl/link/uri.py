"""The forms of a vehicle's URI, and what to do without rights to the radio."""

from __future__ import annotations

import re

from perchctl.errors import InvalidValue

FORMS = {
    "sim": r"sim://",
    "radio": r"radio://(\d+|[0-9A-Fa-f]{10})(/\d{1,3}(/(250K|1M|2M)(/[0-9A-Fa-f]{1,10})?)?)?(\?.+)?",
    "usb": r"usb://\d+",
    "udp": r"udp://[^/:\s]+:\d{1,5}",
    "tcp": r"tcp://[^/:\s]+:\d{1,5}",
    "serial": r"serial://.+",
}
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
    if scheme in FORMS and re.fullmatch(FORMS[scheme], uri):
        port = uri.rpartition(":")[2] if scheme in ("udp", "tcp") else "1"
        if 0 < int(port) <= 65535:
            return scheme
        raise InvalidValue(f"URI {uri!r} has no port of 1 to 65535; examples: {EXAMPLES}")
    raise InvalidValue(f"URI {uri!r} is not one of a vehicle; examples: {EXAMPLES}")
