"""Seeded flights, each with a fault out of a selection."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

from perchctl.faults.flight import fly_fault_seed
from perchctl.faults.result import FaultResult
from perchctl.flight import fly_all, seed_log_path
from perchctl.profile import Profile


def run_fault_campaign(
    profile: Profile,
    seeds: Iterable[int],
    faults: tuple[str, ...],
    executor: Executor | None = None,
    on_result: Callable[[FaultResult], None] = lambda result: None,
    log_dir: Path | None = None,
    record: bool = False,
) -> list[FaultResult]:
    """Fly all seeds, as `perchctl.flight.campaign.run_campaign` does."""
    return fly_all(
        partial(_fly_logged, profile, faults, log_dir, record), seeds, executor, on_result
    )


def _fly_logged(
    profile: Profile, faults: tuple[str, ...], log_dir: Path | None, record: bool, seed: int
) -> FaultResult:
    log = None if log_dir is None else seed_log_path(seed, log_dir)
    return fly_fault_seed(profile, seed, faults, log, record)
