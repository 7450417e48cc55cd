"""A worker flies only what it would fly as the computer of the campaign does."""

from __future__ import annotations

import asyncio
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
pytest.importorskip("distributed", reason="clusters need the extra [cluster]")


import perchctl
from perchctl.calibration import profile_camera
from perchctl.campaign import workers
from perchctl.campaign.workers import (
    WorkerReport,
    WorkerRequirements,
    fitness,
    flight_order,
    fly_order,
    source_sha256,
    verify_scheduler,
    verify_workers,
    worker_requirements,
)
from perchctl.errors import ConnectionFailed, InvalidValue
from perchctl.places import data_file
from perchctl.profile import Profile, load_profile
from tests.helpers.seeds import Ended, ends_at_once

ADDRESS = "tcp://10.0.0.5:4001"


@pytest.fixture
def required() -> WorkerRequirements:
    with worker_requirements([], None) as found:
        return found


# --- what a worker answers --------------------------------------------------------------------


def test_a_worker_like_this_computer_may_fly(tmp_path: Path) -> None:
    with worker_requirements([load_profile("sim"), load_profile("rough")], tmp_path) as found:
        assert len(list(tmp_path.iterdir())) == 1
        answer = fitness(found, 1)
        assert answer.problem is None
        assert len(answer.arithmetic) == 8
    assert list(tmp_path.iterdir()) == []


def test_another_source_is_seen_whatever_the_version(
    required: WorkerRequirements, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "perchctl"
    (copy / "flight").mkdir(parents=True)
    for name in ("__init__.py", "flight/loop.py"):
        shutil.copyfile(Path(perchctl.__file__).parent / name, copy / name)

    here = source_sha256(copy)
    text = (copy / "flight/loop.py").read_bytes()
    (copy / "flight/loop.py").write_bytes(text.replace(b"\n", b"\r\n"))
    assert source_sha256(copy) == here
    (copy / "flight/loop.py").write_bytes(text + b"# another\n")
    there = source_sha256(copy)
    assert there != here
    monkeypatch.setattr(workers, "SOURCE", there)
    assert fitness(replace(required, source=there), 1).problem is None
    problem = fitness(replace(required, source=here, program="perchctl 0.2.0 (abc)"), 1).problem
    assert problem is not None
    assert problem.startswith(f"has perchctl {perchctl.__version__}")
    assert problem.endswith(
        f" with the source {there[:8]}, and here it is perchctl 0.2.0 (abc) with {here[:8]}: "
        f"install the same there, and start its workers again"
    )


def test_other_libraries_are_named_with_both_versions(required: WorkerRequirements) -> None:
    own = dict(required.libraries)
    assert set(own) == {"python", "opencv", "numpy", "mujoco", "filterpy", "distributed"}
    assert "none" not in own.values()
    other = replace(
        required, libraries=(*required.libraries[:2], ("numpy", "1.0"), ("newest", "7"))
    )
    assert fitness(other, 1).problem == (
        f"has numpy {own['numpy']} and newest none, and here it is numpy 1.0 and newest 7: install "
        f"the same there, and start its workers again"
    )


def test_two_flights_in_one_process_are_refused(required: WorkerRequirements) -> None:
    problem = fitness(required, 16).problem
    assert problem is not None
    assert problem.endswith("start it as dask worker --nthreads 1 --nworkers 16")


def test_another_calibration_or_none_is_seen(tmp_path: Path) -> None:
    """The profile is sent; the files that it names are not."""
    shipped = data_file("calib", load_profile("sim").camera.calibration)
    assert shipped is not None
    file = tmp_path / "camera.yaml"
    shutil.copyfile(shipped, file)
    (tmp_path / "mine.yaml").write_text("extends: sim\ncamera: {calibration: camera.yaml}\n")
    with worker_requirements([load_profile(str(tmp_path / "mine.yaml"))], None) as found:
        assert fitness(found, 1).problem is None
        text = file.read_text()
        focal = str(profile_camera(found.profiles[0][0].camera).K[0, 0])
        assert focal in text
        file.write_text(text.replace(focal, f"{float(focal) + 1.0}"))
        problem = fitness(found, 1).problem
        assert problem == (
            f"has another {file} for mine than there is here: bring this computer's there"
        )
        file.unlink()
        problem = fitness(found, 1).problem
        assert problem is not None
        assert problem.startswith(f"cannot fly mine: calibration file {file} not found")


def test_of_profiles_with_the_same_files_one_is_sent_to_be_checked() -> None:
    sim, rough = load_profile("sim"), load_profile("rough")
    with worker_requirements([sim, rough], None) as found:
        assert len(found.profiles) == 1


def test_a_folder_that_is_not_shared_is_refused(tmp_path: Path) -> None:
    """One of the same path on another disk is not the same folder."""
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    ours.mkdir()
    theirs.mkdir()
    with worker_requirements([], ours) as found:
        there = replace(found, folder=theirs)
        words = "to {}: name one in --log-dir that all computers have at this path"
        unseen = "does not see what this computer writes " + words
        assert fitness(there, 1).problem == unseen.format(theirs)
        shutil.copyfile(found.mark, there.mark)
        assert fitness(there, 1).problem is None
        there.mark.write_text("of another campaign")
        assert fitness(there, 1).problem == unseen.format(theirs)
        assert [path.name for path in theirs.iterdir()] == [there.mark.name]


def test_a_folder_that_a_worker_cannot_write_to_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_path: Path, *_args: object, **_named: object) -> None:
        raise OSError(28, "No space left on device")

    with worker_requirements([], tmp_path) as found:
        monkeypatch.setattr(Path, "write_text", full)
        problem = fitness(found, 1).problem
    assert problem is not None
    assert problem.startswith(f"cannot write to {tmp_path} (No space left on device): name one in")


def test_a_folder_that_nothing_can_be_written_to_here_is_told(tmp_path: Path) -> None:
    with (
        pytest.raises(InvalidValue, match="cannot be written"),
        worker_requirements([], tmp_path / "none"),
    ):
        raise AssertionError


# --- a worker that came later --------------------------------------------------------------


@pytest.fixture
def on_a_worker(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    def on(threads: int) -> None:
        there = SimpleNamespace(address=ADDRESS, state=SimpleNamespace(nthreads=threads))
        monkeypatch.setattr(workers, "get_worker", lambda: there)

    return on


def test_one_that_came_later_is_asked_with_its_first_flight(
    required: WorkerRequirements, on_a_worker: Callable[[int], None], tmp_path: Path
) -> None:
    on_a_worker(2)
    good, error = pickle.loads(fly_order(flight_order(ends_at_once, (1,)), required))
    assert not good
    assert isinstance(error, InvalidValue)
    assert str(error).startswith(f"worker {ADDRESS} on ")
    assert "flies 2 flights in one process" in str(error)
    with worker_requirements([], tmp_path) as other:
        on_a_worker(1)
        good, ended = pickle.loads(fly_order(flight_order(ends_at_once, (1,)), other))
        assert good
        assert isinstance(ended, Ended)
        assert [path.name for path in tmp_path.iterdir()] == [other.mark.name]


# --- those that are there --------------------------------------------------------------------


class Client:
    """A cluster's workers, each with what it answers."""

    def __init__(self, answers: dict[str, Any]) -> None:
        self.answers = answers

    async def run(
        self, _fn: object, _required: WorkerRequirements, on_error: str
    ) -> dict[str, Any]:
        assert on_error == "return"
        return self.answers


def verified(required: WorkerRequirements, **answers: Any) -> list[str]:
    return asyncio.run(verify_workers(Client(answers), required))


def test_a_scheduler_of_another_version_is_told() -> None:
    """The two would not understand each other, and say so by none answering."""

    async def versions() -> dict[str, Any]:
        return {"packages": {"distributed": "1.0"}}

    client = SimpleNamespace(scheduler=SimpleNamespace(versions=versions))
    with pytest.raises(InvalidValue, match=r"at here has distributed 1\.0, and here it is "):
        asyncio.run(verify_scheduler(client, "here"))


def test_the_first_that_must_not_fly_is_told_and_how_many_more(
    required: WorkerRequirements,
) -> None:
    bad = WorkerReport("node7", "has numpy 1: install the same there")
    with pytest.raises(InvalidValue) as told:
        verified(required, c=bad, b=bad, a=WorkerReport("node1", None, "x"))
    assert str(told.value) == ("worker b on node7 has numpy 1: install the same there (and 1 more)")


def test_one_without_this_perchctl_is_told(required: WorkerRequirements) -> None:
    with pytest.raises(InvalidValue) as told:
        verified(required, a=ModuleNotFoundError("No module named 'perchctl'"))
    assert str(told.value) == (
        "worker a cannot load what flies (ModuleNotFoundError: No module named 'perchctl'): "
        "install this computer's perchctl there, with the extras sim and cluster"
    )


def test_one_that_has_gone_meanwhile_stops_nothing(required: WorkerRequirements) -> None:
    own = fitness(required, 1)
    assert verified(required, a=own, b=ConnectionResetError()) == []


def test_another_processor_is_worth_a_note(required: WorkerRequirements) -> None:
    own = fitness(required, 1)
    (note,) = verified(required, a=own, b=replace(own, arithmetic="00000000"))
    assert note.startswith("1 of 2 workers have another processor")


def test_workers_that_hang_are_told(
    required: WorkerRequirements, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Hanging(Client):
        async def run(self, *_args: Any, **_named: Any) -> dict[str, Any]:
            await asyncio.Event().wait()
            return {}

    monkeypatch.setattr(workers, "ANSWERS_S", 0.01)
    with pytest.raises(ConnectionFailed, match="not all workers answer within"):
        asyncio.run(verify_workers(Hanging({}), required))


def test_what_a_worker_writes_has_to_be_seen_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And is taken away."""
    with worker_requirements([], tmp_path) as found:
        own = replace(fitness(found, 1), file=".left")
        (tmp_path / ".left").write_text(found.token)
        assert verified(found, a=own) == []
        assert not (tmp_path / ".left").exists()
        monkeypatch.setattr(workers, "SEEN_S", 0.0)
        with pytest.raises(InvalidValue) as told:
            verified(found, a=own)
        assert str(told.value) == (
            f"what worker a on {own.host} writes to {tmp_path} is not seen here: name a folder in "
            f"--log-dir that all computers share"
        )


def test_a_profile_is_sent_small() -> None:
    """It goes with each flight."""
    with worker_requirements([Profile()], None) as found:
        assert len(pickle.dumps(found)) < 20_000
