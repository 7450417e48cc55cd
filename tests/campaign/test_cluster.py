"""A real scheduler, and workers that are killed, must not fly, or never come."""

from __future__ import annotations

import importlib.util
import pickle
import shutil
import signal
import socket
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
pytest.importorskip("distributed", reason="clusters need the extra [cluster]")

from perchctl.campaign import FlightResult, cluster, cluster_pool, flight_processes, fly_all
from perchctl.campaign.cluster import WorkerRequirements, fly_verified, worker_requirements
from perchctl.campaign.flights import fly_seed
from perchctl.errors import ConnectionFailed, InvalidValue, PerchError, UsageError
from perchctl.places import data_file
from perchctl.profile import load_profile
from tests.helpers.cluster import dies_in_flight, scheduler, worker
from tests.helpers.commands import elsewhere, run  # noqa: F401
from tests.helpers.ended import ended
from tests.helpers.flights import ROOT, SEED, SHORT
from tests.helpers.results import flown_record
from tests.helpers.seeds import Ended, ends_at_once, ends_first_only, fails_later

# --- the address, and what it goes together with ------------------------------------------------


@pytest.mark.parametrize("address", ["localhost", "http://10.0.0.5:1"])
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(UsageError, match=r"must be "), cluster_pool(address, []):
        raise AssertionError


def test_jobs_do_not_go_with_it() -> None:
    said = run("simulate", "--jobs", "2", "--cluster", "here:1")
    assert said.code == UsageError.exit_code
    assert "--jobs 2 does not apply" in said.stderr


def test_without_the_library_one_sentence_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    there = importlib.util.find_spec
    hide = lambda name, *rest: None if name == "distributed" else there(name, *rest)  # noqa: E731
    monkeypatch.setattr("perchctl.commands.simulate.find_spec", hide)
    said = run("simulate", "-p", SHORT, "-n", "2", "--cluster", "here:1")
    assert said.code == 2
    assert said.complaint.endswith("-m pip install 'perchctl[cluster]'")


def test_an_address_that_nobody_answers_is_told_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "SCHEDULER_TIMEOUT_S", 0.3)
    with socket.socket() as deaf:  # is bound, and takes no call
        deaf.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{deaf.getsockname()[1]}"
        said = run("simulate", "-p", SHORT, "-n", "2", "--cluster", address)
    assert said.code == 10
    assert said.stdout == ""
    assert said.complaint.startswith(f"no dask scheduler answers at {address} within")


# --- what a worker must have --------------------------------------------------------------------


def flown_by(required: WorkerRequirements, patch: pytest.MonkeyPatch, threads: int = 1) -> Ended:
    """Fly in this process as a worker does that has flown nothing yet."""
    state = SimpleNamespace(nthreads=threads)
    there = SimpleNamespace(address="tcp://10.0.0.5:4001", state=state)
    patch.setattr(cluster, "get_worker", lambda: there)
    patch.setattr(cluster, "_differences", {})
    order = pickle.dumps((ends_at_once, (1,), {}))
    result: Ended = fly_verified(order, required)
    return result


def test_a_worker_like_this_computer_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    found = worker_requirements([load_profile("sim"), load_profile("rough")])
    assert flown_by(found, monkeypatch).seed == 1
    assert len(pickle.dumps(found)) < 20_000  # it goes with each flight


@pytest.mark.parametrize(
    "name", ["perchctl", "python", "opencv", "numpy", "mujoco-core", "filterpy", "distributed"]
)
def test_another_program_or_library_is_named_with_both_versions(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = worker_requirements([])
    other = replace(own, environment={**own.environment, name: "0.1"})
    with pytest.raises(
        InvalidValue, match=rf"^worker tcp://10\S+ on .* has {name} \S+.* instead of 0\.1: "
    ):
        flown_by(other, monkeypatch)
    with pytest.raises(InvalidValue, match="--nthreads 16 instead of 1"):
        flown_by(own, monkeypatch, threads=16)


def test_another_calibration_or_none_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The profile is sent; the files that it names are not."""
    shipped = data_file("calib", load_profile("sim").camera.calibration)
    assert shipped is not None
    file = tmp_path / "camera.yaml"
    shutil.copyfile(shipped, file)
    (tmp_path / "mine.yaml").write_text("extends: sim\ncamera: {calibration: camera.yaml}\n")
    found = worker_requirements([load_profile(str(tmp_path / "mine.yaml"))])
    assert flown_by(found, monkeypatch)
    file.write_text(file.read_text().replace("1", "2"))
    for _ in range(2):
        with pytest.raises(InvalidValue, match="has calibration or mask"):
            flown_by(found, monkeypatch)
        file.unlink(missing_ok=True)


# --- a scheduler that is there, with workers as users start them --------------------------------


@pytest.mark.long
def test_two_workers_one_of_which_is_killed(tmp_path: Path) -> None:
    """dask hands its flight to the other; each seed counts once, and ends as in one process. Then
    the scheduler is lost."""
    marks = tmp_path / "marks"
    marks.mkdir()
    profile = load_profile(SHORT)
    with scheduler(tmp_path) as (address, process), ExitStack() as stack:
        workers = [stack.enter_context(worker(address, tmp_path)) for _ in range(2)]
        pool = stack.enter_context(cluster_pool(address, [profile]))
        told: list[Ended] = []
        flown = fly_all(ends_at_once, [3, 0, 3, 2], pool, told.append)
        assert [flight.seed for flight in flown] == [3, 0, 2]
        assert sorted(flight.seed for flight in told) == [0, 2, 3]
        assert {flight.pid for flight in flown} <= {each.pid for each in workers}
        with pytest.raises(
            PerchError, match="unexpected ZeroDivisionError in the flight with seed"
        ):
            fly_all(fails_later, [0, 1], pool)
        fly = partial(dies_in_flight, profile, marks, (SEED,))
        (survivor,) = fly_all(fly, [SEED], pool)
        assert [path.name for path in marks.iterdir()] == [str(SEED)]
        assert flown_record(survivor) == flown_record(fly_seed(profile, SEED))

        def lose(result: Ended) -> None:
            process.kill()

        with pytest.raises(ConnectionFailed, match="no longer answers: restart it; if"):
            fly_all(ends_first_only, [0, 1, 2], pool, lose)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_program_that_is_ended_tells_what_was_flown(
    number: signal.Signals, tmp_path: Path
) -> None:
    """A terminal sends its signals to all that it started."""
    with scheduler(tmp_path) as (address, _process), worker(address, tmp_path):
        it = ended(number, 1.0, address)
    if number != signal.SIGKILL:
        assert it.code == 130
        assert it.out == "report 1 stopped: 1 of 6 flights were flown\n"
        assert it.err.endswith("perchctl: stopped: 1 of 6 flights were flown\n")


@pytest.mark.long
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
            pytest.raises(ConnectionFailed, match=r"has no worker: .* dask worker tcp://"),
            cluster_pool(address, []),
        ):
            raise AssertionError
        monkeypatch.setattr(cluster, "WORKERS_S", 60.0)
        with (
            worker(address, tmp_path, root=other),
            cluster_pool(address, []) as pool,
            pytest.raises(InvalidValue, match=r"^worker tcp://127\S+ on .* has perchctl "),
        ):
            fly_all(ends_at_once, range(2), pool)


# --- who flies a seed changes nothing of it -----------------------------------------------------


@pytest.mark.campaign
def test_forty_seeds_in_one_process_in_two_and_on_a_cluster(tmp_path: Path) -> None:
    """Two of them lose the cluster's worker at first, on the way up."""
    profile, seeds, deadly = load_profile("sim"), range(40), (7, 23)

    def flown(executor: Executor, fly: Callable[[int], FlightResult]) -> list[dict[str, Any]]:
        return [flown_record(result) for result in fly_all(fly, seeds, executor)]

    with flight_processes(1) as one:
        alone = flown(one, partial(fly_seed, profile))
    assert [record["seed"] for record in alone] == list(seeds)
    with flight_processes(2) as two:
        assert flown(two, partial(fly_seed, profile)) == alone
    marks = tmp_path / "marks"
    marks.mkdir()
    with scheduler(tmp_path) as (address, _process), ExitStack() as stack:
        for _ in range(4):
            stack.enter_context(worker(address, tmp_path))
        pool = stack.enter_context(cluster_pool(address, [profile]))
        assert flown(pool, partial(dies_in_flight, profile, marks, deadly)) == alone
    assert sorted(path.name for path in marks.iterdir()) == sorted(map(str, deadly))
