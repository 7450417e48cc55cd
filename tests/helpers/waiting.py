"""Waiting with a bound for what another thread or process does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any


def until(condition: Callable[[], Any], limit_s: float = 20.0) -> Any:
    """What `condition` returns once that is true; fails when it stays away so long."""
    end_s, pause = time.monotonic() + limit_s, threading.Event()
    while not (value := condition()):
        assert time.monotonic() < end_s, "waited in vain"
        pause.wait(0.003)
    return value
