"""Log variables and parameters of a connected vehicle, by name: verified, set and read, bounded."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from perchctl.errors import ConnectionFailed, InvalidValue, NotFound, TimedOut
from perchctl.link.telemetry import NEEDED, start_block
from perchctl.values import replace
from perchctl.vehicle import MeasuredBy

NEEDED_PROTOCOL = 12
"""From firmware 2026.08 on: the supervisor's own port (docs/firmware.md, "Link")."""
PARAMETER_TIMEOUT_S = 2.0


def check_firmware(cf: Any, uri: str) -> None:
    """Raises ConnectionFailed for an old protocol, NotFound for a missing log variable."""
    version = cf.platform.get_protocol_version()
    if version < NEEDED_PROTOCOL:
        raise ConnectionFailed(
            f"the firmware at {uri} has protocol {version}, perchctl needs "
            f"{NEEDED_PROTOCOL} or later (release 2026.08): update the firmware"
        )
    for name in missing_variables(cf):
        raise NotFound(
            f"the firmware at {uri} has no log variable {name}, which perchctl "
            f"needs: update the firmware to release 2026.08 or later"
        )


def missing_variables(cf: Any) -> list[str]:
    """Those of the needed ones that the firmware does not log."""
    toc = cf.log.toc
    return [name for name in NEEDED if toc.get_element_by_complete_name(name) is None]


def set_parameters(
    cf: Any, uri: str, parameters: Mapping[str, float], needed_by: str | None = None
) -> None:
    """Set each parameter and verify it.

    `needed_by`: what they are for, where they are not the user's own. Raises NotFound for an
    unknown name, InvalidValue for a value that the vehicle does not keep, TimedOut without an
    answer.
    """
    for name, wanted in parameters.items():
        _check_known(cf, uri, name, needed_by)
        _set_parameter(cf.param, name, wanted)


def order_parameter(cf: Any, uri: str, name: str, value: float, needed_by: str) -> None:
    """Set one that is an order, and is not to be read back. Raises as `set_parameters`."""
    _check_known(cf, uri, name, needed_by)
    try:
        cf.param.set_value(name, str(value))
    except (AttributeError, ValueError, KeyError) as error:
        raise InvalidValue(f"parameter {name} cannot be set to {value}: {error}") from None


def _check_known(cf: Any, uri: str, name: str, needed_by: str | None) -> None:
    if cf.param.toc.get_element_by_complete_name(name) is not None:
        return
    if needed_by is None:
        remedy = ": correct link.parameters in the profile"
    else:
        remedy = f", which {needed_by} needs: update the firmware to release 2026.08 or later"
    raise NotFound(f"the firmware at {uri} has no parameter {name}{remedy}")


def _set_parameter(parameters: Any, name: str, wanted: float) -> None:
    """Set, then read it back from the vehicle and compare."""
    group, _, short = name.partition(".")
    answered = threading.Event()
    answers: list[str] = []

    def on_value(_name: str, value: str) -> None:
        answers.append(value)
        answered.set()

    try:
        parameters.set_value(name, str(wanted))
        parameters.add_update_callback(group=group, name=short, cb=on_value)
        parameters.request_param_update(name)
        if not answered.wait(PARAMETER_TIMEOUT_S):
            raise TimedOut(f"parameter {name} was set to {wanted}, but no answer came")
    except (AttributeError, ValueError, KeyError) as error:
        raise InvalidValue(f"parameter {name} cannot be set to {wanted}: {error}") from None
    finally:
        parameters.remove_update_callback(group, short, on_value)
    if not math.isclose(float(answers[-1]), float(wanted), rel_tol=1e-5, abs_tol=1e-9):
        raise InvalidValue(
            f"parameter {name} was set to {wanted}, but the vehicle keeps {answers[-1]}"
        )


# --- What tells the vehicle where it is, and the values of single variables --------------------


ANSWER_S = 1.5
LISTEN_S = 1.0
"""Positions from outside that come less than once a second are none to fly by."""
EXTERNAL_POSITION_TICK = "locSrvZ.tick"
"""When the newest position from outside came, ms (source): steps with each of them."""
_BLOCK_BYTES = 26


def parameters(cf: Any) -> dict[str, float]:
    """All, as they were read when the link was opened."""
    return {
        f"{group}.{name}": float(value)
        for group, values in cf.param.values.items()
        for name, value in values.items()
    }


def decks_found(parameters: Mapping[str, float]) -> tuple[str, ...]:
    """The decks that were found at boot, by the firmware's names, sorted."""
    names = (n.removeprefix("deck.") for n, v in parameters.items() if v and n.startswith("deck."))
    return tuple(sorted(names))


def measured_by(cf: Any, wait: Callable[[float], None] = time.sleep) -> MeasuredBy:
    """What tells the vehicle where it is. Only one without a positioning deck is listened to."""
    by = MeasuredBy(decks_found(parameters(cf)))
    if by.position_decks:
        return by
    before = variables(cf, [EXTERNAL_POSITION_TICK]).get(EXTERNAL_POSITION_TICK)
    wait(LISTEN_S)
    after = variables(cf, [EXTERNAL_POSITION_TICK]).get(EXTERNAL_POSITION_TICK)
    external = None if before is None or after is None else after != before
    return replace(by, external=external)


def has_variable(cf: Any, name: str) -> bool:
    return cf.log.toc.get_element_by_complete_name(name) is not None


def variables(cf: Any, names: Iterable[str]) -> dict[str, float]:
    """The newest values of log variables; without those that are missing or do not come."""
    known = [name for name in names if has_variable(cf, name)]
    values: dict[str, float] = {}
    for block in _blocks(known):
        values |= _read(cf, block)
    return values


def _read(cf: Any, names: list[str]) -> dict[str, float]:
    arrived = threading.Event()
    values: dict[str, float] = {}

    def on_data(_stamp: int, data: Mapping[str, float], _block: Any) -> None:
        values.update(data)
        arrived.set()

    try:
        block = start_block(cf.log, "it", "probe", dict.fromkeys(names), 0.05, on_data)
    except (NotFound, KeyError, AttributeError):  # cflib's ways to say that the link is gone
        return {}
    arrived.wait(ANSWER_S)
    block.stop()
    block.delete()
    return values


def _blocks(names: list[str]) -> list[list[str]]:
    """So many as fit into a log block each, whatever their types."""
    each = _BLOCK_BYTES // 4
    return [names[at : at + each] for at in range(0, len(names), each)]
