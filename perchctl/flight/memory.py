"""How much memory a campaign takes."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import resource
import sys
from pathlib import Path

_STATUS = Path("/proc/self/status")
_RSS_UNIT = 1 if sys.platform == "darwin" else 1024  # getrusage's, bytes


def give_back_memory() -> None:
    """What a flight leaves behind. Its objects know of each other, so Python frees them when it
    next looks through everything, which may be many flights later; and the C library keeps what
    it is given back in pieces."""
    gc.collect()
    if not gc.get_freeze_count():
        # What is left are the program's own modules and what it keeps for all flights: nothing
        # to look through again and again, which takes as long as 30 pictures.
        gc.freeze()
    with contextlib.suppress(AttributeError, OSError):  # glibc has it, others do not
        ctypes.CDLL(None).malloc_trim(0)


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
