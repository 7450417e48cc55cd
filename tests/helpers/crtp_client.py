"""A simulated vehicle and a client of it."""

from __future__ import annotations

from cflib.crazyflie.log import LogConfig


def _block(name: str, variables: dict[str, str], period_ms: int = 10) -> LogConfig:
    block = LogConfig(name=name, period_in_ms=period_ms)
    for variable, ctype in variables.items():
        block.add_variable(variable, ctype)
    return block
