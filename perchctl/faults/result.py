"""One flight with a fault: its record."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from perchctl.faults.oracle import FLAGS, Flag
from perchctl.sim import Scenario

End = Literal["perched", "landed", "aborted", "refused", "failed", "gone"]
"""`refused`: never took off; `failed`: an exception ended the flight, behind its rescue; `gone`:
the program ended before its flight."""


@dataclass(frozen=True)
class FaultResult:
    """One flight.

    Attributes:
        flags: what went wrong, with when.
        counted: the flags that no expected outcome covers.
        expected: the names of the expected outcomes whose cause came, whether or not a flag was
            raised; `unavoidable`: their reasons, None where there are none.
        begin_s: when the fault began; None when the flight was over before.
        row: of the mission's table, that ended the flight; empty where none did.
        drop_m: the deepest fall until caught, in the simulation's truth; `slip_ratio`: the
            magnet's hold over the weight, where that was a slip from the magnet.
        touchdown_mps, touchdown_aside_mps: the hardest touchdown, downwards and sideways.
        astray_m: in the air, the farthest from where it should have been.
        log, log_problem: the flight's log, and what it lacks; None without.
        cpu_s, peak_memory_mb, scenario: as `perchctl.campaign.FlightResult` has them.
    """

    seed: int
    fault: str
    phase: str
    moment_s: float
    begin_s: float | None
    parameters: dict[str, Any]
    end: End
    cause: str
    reason: str
    flags: dict[Flag, float]
    counted: tuple[Flag, ...]
    unavoidable: str | None
    time_s: float
    miss_m: float | None
    drop_m: float
    slip_ratio: float | None = None
    wall_s: float = 0.0
    way: tuple[str, ...] = field(default=())
    log: Path | None = None
    log_problem: str | None = None
    cpu_s: float = 0.0
    peak_memory_mb: float = 0.0
    scenario: Scenario | None = None
    row: str = ""
    expected: tuple[str, ...] = ()
    touchdown_mps: float = 0.0
    touchdown_aside_mps: float = 0.0
    astray_m: float = 0.0

    @property
    def outcome(self) -> str:
        return self.end

    @property
    def badness(self) -> tuple[bool, int, int, float]:
        """The larger the worse: by the gravest flag that counts, by how many, then the misses."""
        gravest = max((-FLAGS.index(flag) for flag in self.counted), default=-len(FLAGS))
        return bool(self.counted), gravest, len(self.counted), self.miss_m or 0.0
