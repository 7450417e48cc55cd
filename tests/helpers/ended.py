"""The program of `tests.helpers.jobs`, ended by a signal after its first flight."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Mapping
from typing import NamedTuple

from tests.helpers.flights import ROOT


class Ended(NamedTuple):
    """`child`: whether the process that flew for it ended, too."""

    child: bool
    code: int
    out: str
    err: str


def ended(
    number: signal.Signals, within_s: float, *words: str, env: Mapping[str, str] | None = None
) -> Ended:
    """A terminal sends its signals to all, a kill hits the program alone."""
    with subprocess.Popen(
        [sys.executable, "-m", "tests.helpers.jobs", *words],
        env=os.environ | {"PYTHONPATH": str(ROOT)} | dict(env or {}),
        cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    ) as program:  # fmt: skip
        assert program.stdout is not None
        child = os.pidfd_open(int(program.stdout.readline()))
        if number == signal.SIGKILL:
            program.kill()
        else:
            os.killpg(program.pid, number)
        gone, _, _ = select.select([child], [], [], within_s)
        os.close(child)
        out, err = program.communicate(timeout=within_s)
    return Ended(bool(gone), program.returncode, out, err)
