"""A real scheduler, and workers that are killed, must not fly, or never come."""

from __future__ import annotations

import multiprocessing
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
pytest.importorskip("distributed", reason="clusters need the extra [cluster]")

from perchctl.campaign import cluster, cluster_pool, fly_all, parse_address, run_campaign
from perchctl.campaign.cluster import ClusterPool
from perchctl.campaign.flights import FLOWN_AGAIN
from perchctl.campaign.results_file import flown_record
from perchctl.errors import ConnectionFailed, InvalidValue, PerchError
from perchctl.profile import load_profile
from tests.helpers.cluster import dies_in_flight, scheduler, worker
from tests.helpers.ended import ended
from tests.helpers.flights import ROOT, SEED, SHORT
from tests.helpers.seeds import (
    Ended,
    ends_at_once,
    ends_first_only,
    fails_later,
    is_lost,
    no_form,
)

pytestmark = pytest.mark.long

AT_ONCE_S = 20.0
"""Beside the time for which the flights would go on; on a busy machine, too."""


# --- workers of this computer ----------------------------------------------------------------


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ClusterPool]:
    with cluster_pool(parse_address("local:2"), [load_profile(SHORT)]) as pool:
        yield pool


def workers_of_this_computer() -> set[int | None]:
    return {process.pid for process in multiprocessing.active_children()}


def test_each_flight_is_flown_once_by_a_worker(local: ClusterPool) -> None:
    told: list[int] = []
    flown = fly_all(ends_at_once, [3, 0, 1, 3, 2], local, lambda result: told.append(result.seed))
    assert [flight.seed for flight in flown] == [3, 0, 1, 2]
    assert sorted(told) == [0, 1, 2, 3]
    assert {flight.pid for flight in flown} <= workers_of_this_computer()
    assert local.notes == []


def test_what_fails_is_told_as_in_processes(local: ClusterPool) -> None:
    with pytest.raises(PerchError, match="unforeseen ZeroDivisionError in the flight of seed 1"):
        fly_all(fails_later, [0, 1], local)
    assert isinstance(local.submit(no_form).exception(), RuntimeError)
    assert local.submit(lambda: None).exception() is not None
    assert local.submit(len, (1, 2)).result() == 2


def test_a_lost_worker_is_replaced_and_its_flight_flown_again(
    local: ClusterPool, tmp_path: Path
) -> None:
    """What dask gives up, here after the first time, is the campaign's to hand over again."""
    fly = partial(is_lost, folder=tmp_path, times=FLOWN_AGAIN)
    assert isinstance(local.submit(fly, 1).exception(AT_ONCE_S), BrokenExecutor)
    flown = fly_all(fly, [0, 1, 2, 3], local)
    assert [flight.seed for flight in flown] == [0, 1, 2, 3]
    marks = Counter(path.name[0] for path in tmp_path.iterdir())
    assert marks["1"] == 1 + FLOWN_AGAIN
    # A result that a lost worker still held is flown anew.
    assert sorted(marks) == ["0", "1", "2", "3"]
    assert max(marks[seed] for seed in "023") <= 1 + FLOWN_AGAIN


def test_a_real_flight_survives_a_worker_that_is_killed_in_the_middle(
    local: ClusterPool, tmp_path: Path
) -> None:
    """They end as in one process. (40 whole ones: `test_identical.py`.)"""
    profile = load_profile(SHORT)
    fly = partial(dies_in_flight, profile, tmp_path, (SEED,))
    flown = fly_all(fly, [SEED], local)
    assert [path.name for path in tmp_path.iterdir()] == [str(SEED)]
    alone = run_campaign(profile, [SEED])
    assert [flown_record(flight) for flight in flown] == [flown_record(flight) for flight in alone]


def test_nothing_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No process, no folder, and no page's port of dask's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = workers_of_this_computer()
    with cluster_pool(parse_address("local:1"), []) as pool:
        (pid,) = workers_of_this_computer() - before
        assert fly_all(ends_at_once, [1], pool)[0].pid == pid
        assert len(list(tmp_path.iterdir())) == 1
    end_s = time.monotonic() + AT_ONCE_S
    while list(tmp_path.iterdir()) or Path(f"/proc/{pid}").exists():
        assert time.monotonic() < end_s
        time.sleep(0.02)
    with pytest.raises(RuntimeError):
        pool.submit(ends_at_once, 1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_program_that_is_ended_leaves_nothing_behind(
    number: signal.Signals, tmp_path: Path
) -> None:
    """A terminal sends its signals to all; what was flown is told."""
    it = ended(number, AT_ONCE_S, "local:1", env={"TMPDIR": str(tmp_path)})
    assert it.child
    if number != signal.SIGKILL:
        assert it.code == 130
        assert it.out == "report 1 stopped: 1 of 6 flights were flown\n"
        assert it.err.endswith("perchctl: stopped: 1 of 6 flights were flown\n")
        assert not list(tmp_path.glob("perchctl-cluster-*"))


# --- a scheduler that is there, with workers as users start them ------------------------------


def test_two_workers_one_of_which_is_killed(tmp_path: Path) -> None:
    """dask pool its flight to the other; each seed counts once. Then the scheduler is lost."""
    marks, logs = tmp_path / "marks", tmp_path / "logs"
    marks.mkdir()
    logs.mkdir()
    with scheduler(tmp_path) as (address, process), ExitStack() as stack:
        workers = [stack.enter_context(worker(address, tmp_path)) for _ in range(2)]
        pool = stack.enter_context(
            cluster_pool(parse_address(address), [load_profile("sim")], logs)
        )
        flown = fly_all(partial(is_lost, folder=marks, times=1), [0, 1, 2, 3], pool)
        assert [flight.seed for flight in flown] == [0, 1, 2, 3]
        assert {flight.pid for flight in flown} <= {each.pid for each in workers}
        assert Counter(path.name[0] for path in marks.iterdir()) == {"0": 1, "1": 2, "2": 1, "3": 1}
        assert len(list(logs.iterdir())) == 1  # the mark of this campaign

        told: list[Ended] = []

        def lose(result: Ended) -> None:
            told.append(result)
            process.kill()

        with pytest.raises(ConnectionFailed, match="does not answer any more: start it again, and"):
            fly_all(ends_first_only, [0, 1, 2], pool, lose)
        assert [flight.seed for flight in told] == [0]
        error = pool.submit(ends_at_once, 1).exception(AT_ONCE_S)
        assert isinstance(error, ConnectionFailed)
    assert list(logs.iterdir()) == []


def test_workers_that_must_not_fly_and_none_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other"
    shutil.copytree(ROOT / "perchctl", other / "perchctl")
    with (other / "perchctl" / "geometry.py").open("a") as file:
        file.write("# another\n")
    with scheduler(tmp_path) as (address, _process):
        monkeypatch.setattr(cluster, "WORKERS_S", 0.3)
        with (
            pytest.raises(ConnectionFailed, match=r"has had no worker for .* dask worker tcp://"),
            cluster_pool(parse_address(address), []),
        ):
            raise AssertionError
        monkeypatch.setattr(cluster, "WORKERS_S", 60.0)
        unfit = partial(pytest.raises, InvalidValue, match=r"^worker tcp://127.* the source ")
        with worker(address, tmp_path), cluster_pool(parse_address(address), []) as pool:
            assert fly_all(ends_at_once, [1], pool)
            pool.submit(ends_first_only, 1)
            with worker(address, tmp_path, root=other):  # comes later
                with unfit():
                    fly_all(ends_at_once, range(2, 4), pool)
                with unfit(), cluster_pool(parse_address(address), []):
                    raise AssertionError
