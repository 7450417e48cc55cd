"""Log variables and parameters of a connected vehicle, asked for by name. Bounded."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from perchctl.values import replace
from perchctl.vehicle import MeasuredBy

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
    from cflib.crazyflie.log import LogConfig

    arrived = threading.Event()
    values: dict[str, float] = {}

    def on_data(_stamp: int, data: dict[str, float], _block: Any) -> None:
        values.update(data)
        arrived.set()

    block = LogConfig(name="perch_probe", period_in_ms=50)
    for name in names:
        block.add_variable(name)
    block.data_received_cb.add_callback(on_data)
    try:
        cf.log.add_config(block)
        block.start()
    except (KeyError, AttributeError):  # cflib's ways to say that the link is gone
        return {}
    arrived.wait(ANSWER_S)
    block.stop()
    block.delete()
    return values


def _blocks(names: list[str]) -> list[list[str]]:
    """So many as fit into a log block each, whatever their types."""
    each = _BLOCK_BYTES // 4
    return [names[at : at + each] for at in range(0, len(names), each)]
