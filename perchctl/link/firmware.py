"""Check, set and read a connected vehicle's log variables and parameters by name, with timeouts."""

from __future__ import annotations

import contextlib
import math
import queue
from collections.abc import Mapping
from typing import Any

from perchctl.errors import ConnectionFailed, InvalidValue, NotFound, TimedOut
from perchctl.link.connection import send_packets
from perchctl.link.crtp import Packet, Port
from perchctl.link.telemetry import NEEDED
from perchctl.vehicle import AIRFRAMES

NEEDED_PROTOCOL = 12
"""Protocol version of firmware 2026.08 and later, in which the supervisor has its own port
(docs/firmware.md, "Link")."""
PARAMETER_TIMEOUT_S = 2.0
"""Timeout for the answer to a parameter request, s."""
ASKED_TIMES = 10
"""Number of requests for the vehicle type."""
_VERSION_CHANNEL, _DEVICE_TYPE = 1, b"\x02"


def check_firmware(cf: Any, uri: str) -> None:
    """Raise ConnectionFailed if the protocol is too old, and NotFound if a log variable is
    missing."""
    version, remedy = cf.platform.get_protocol_version(), "update the firmware to 2026.08 or later"
    if version < NEEDED_PROTOCOL:
        raise ConnectionFailed(
            f"the firmware at {uri} has protocol {version}, but perchctl needs "
            f"{NEEDED_PROTOCOL} or later: {remedy}"
        )
    for name in missing_variables(cf):
        raise NotFound(f"the firmware at {uri} has no log variable {name}: {remedy}")


def read_device_type(cf: Any) -> str | None:
    """Return the type of vehicle that the firmware reports; None if it does not answer within a
    timeout.

    cflib 0.1.34 never requests the type.
    """
    answers: queue.SimpleQueue[str] = queue.SimpleQueue()

    def on_packet(packet: Any) -> None:
        data = bytes(packet.data)
        if data[:1] == _DEVICE_TYPE:
            answers.put(data[1:].split(b"\0")[0].decode("utf-8", "replace").strip())

    cf.add_header_callback(on_packet, Port.PLATFORM, _VERSION_CHANNEL)
    try:
        for _ in range(ASKED_TIMES):
            send_packets(cf, [Packet(Port.PLATFORM, _VERSION_CHANNEL, _DEVICE_TYPE)])
            with contextlib.suppress(queue.Empty):
                return answers.get(timeout=PARAMETER_TIMEOUT_S / ASKED_TIMES)
        return None
    finally:
        cf.remove_header_callback(on_packet, Port.PLATFORM, _VERSION_CHANNEL)


def check_airframe(cf: Any, uri: str) -> None:
    """Raise ConnectionFailed for a vehicle type for which perchctl has no thrust or battery
    figures."""
    device_type = read_device_type(cf)
    if device_type in AIRFRAMES:
        return
    found = f"is a {device_type}" if device_type else "does not report its airframe"
    raise ConnectionFailed(
        f"the vehicle at {uri} {found}: perchctl's thrust and battery figures hold only for a "
        f"{', '.join(AIRFRAMES[:-1])} or {AIRFRAMES[-1]}; fly one of these"
    )


def missing_variables(cf: Any) -> list[str]:
    """Return the names of the needed log variables that the firmware lacks."""
    table = cf.log.toc
    return [name for name in NEEDED if table.get_element_by_complete_name(name) is None]


def set_parameters(
    cf: Any, uri: str, parameters: Mapping[str, float], *, read_back: bool = True
) -> None:
    """Set each parameter and, with `read_back`, read it back from the vehicle and compare.

    Raises NotFound for an unknown name, InvalidValue for a value that the vehicle does not keep,
    and TimedOut without an answer.
    """
    for name, wanted in parameters.items():
        if cf.param.toc.get_element_by_complete_name(name) is None:
            raise NotFound(
                f"the firmware at {uri} has no parameter {name}: correct link.parameters in the "
                f"profile, or update the firmware to 2026.08 or later"
            )
        kept: str | None = str(wanted)
        try:
            cf.param.set_value(name, kept)
            if read_back:
                kept = _read_back(cf.param, name)
        except (AttributeError, ValueError, KeyError) as error:
            raise InvalidValue(f"parameter {name} cannot be set to {wanted}: {error}") from None
        if kept is None:
            raise TimedOut(f"parameter {name} was set to {wanted}, but the vehicle did not answer")
        if not math.isclose(float(kept), float(wanted), rel_tol=1e-5, abs_tol=1e-9):
            raise InvalidValue(
                f"parameter {name} was set to {wanted}, but the vehicle keeps {kept}"
            )


def _read_back(parameters: Any, name: str) -> str | None:
    group, _, short = name.partition(".")
    answers: queue.SimpleQueue[str] = queue.SimpleQueue()

    def on_value(_name: str, value: str) -> None:
        answers.put(value)

    parameters.add_update_callback(group=group, name=short, cb=on_value)
    try:
        parameters.request_param_update(name)
        return answers.get(timeout=PARAMETER_TIMEOUT_S)
    except queue.Empty:
        return None
    finally:
        parameters.remove_update_callback(group, short, on_value)


def read_parameters(cf: Any) -> dict[str, float]:
    """Return all parameters by name, as read when the link was opened."""
    return {
        f"{group}.{name}": float(value)
        for group, values in cf.param.values.items()
        for name, value in values.items()
    }


def detected_decks(parameters: Mapping[str, float]) -> tuple[str, ...]:
    """Return the decks found at boot, by the firmware's names, sorted."""
    names = (n.removeprefix("deck.") for n, v in parameters.items() if v and n.startswith("deck."))
    return tuple(sorted(names))
