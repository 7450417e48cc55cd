"""How much memory a campaign takes."""

from __future__ import annotations

import contextlib
import resource
import sys
from pathlib import Path

_STATUS = Path("/proc/self/status")
_RSS_UNIT = 1 if sys.platform == "darwin" else 1024  # getrusage's, bytes


def peak_memory_mb() -> float:
    """The most that this process, or any that it has waited for, ever held (1e6 bytes)."""
    own, ended = (
        resource.getrusage(who).ru_maxrss * _RSS_UNIT * 1e-6
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    # Linux hands a program the peak of the one that started it; its own is told elsewhere.
    with contextlib.suppress(OSError, ValueError, IndexError):
        lines = _STATUS.read_text().splitlines()
        own = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1024e-6
    return max(own, ended)
