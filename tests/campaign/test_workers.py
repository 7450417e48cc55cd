"""A worker flies only what it would fly as the computer of the campaign does."""

from __future__ import annotations

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

from perchctl.calibration import profile_camera
from perchctl.campaign import workers
from perchctl.campaign.workers import (
    WorkerReport,
    WorkerRequirements,
    fitness,
    fly_verified,
    verify_cluster,
    worker_requirements,
)
from perchctl.errors import ConnectionFailed, InvalidValue
from perchctl.places import data_file
from perchctl.profile import Profile, load_profile
from tests.helpers.seeds import Ended, ends_at_once


@pytest.fixture
def required() -> WorkerRequirements:
    with worker_requirements([], None) as found:
        return found


def problem_of(required: WorkerRequirements, threads: int = 1) -> str:
    return fitness(required, threads).problem or ""


# --- what a worker finds of itself --------------------------------------------------------------


def test_a_worker_like_this_computer_may_fly(tmp_path: Path) -> None:
    with worker_requirements([load_profile("sim"), load_profile("rough")], tmp_path) as found:
        assert len(list(tmp_path.iterdir())) == 1
        assert len(found.profiles) == 1  # both name the same files
        report = fitness(found, 1)
        assert report.problem is None
        assert len(report.arithmetic) == 8
        assert len(list(tmp_path.iterdir())) == 1
    assert list(tmp_path.iterdir()) == []


def test_another_source_or_library_is_named_with_both_versions(
    required: WorkerRequirements,
) -> None:
    own = required.libraries
    assert set(own) == {"python", "opencv", "numpy", "mujoco", "filterpy", "distributed"}
    assert "none" not in own.values()
    other = replace(
        required, program="perchctl 0.2.0", source="0123456789", libraries={**own, "numpy": "1.0"}
    )
    found, wanted = problem_of(other).split(", and here it is ")
    assert f"{required.program} {required.source[:8]}" in found
    assert f"numpy {own['numpy']}" in found
    assert "perchctl 0.2.0 01234567" in wanted
    assert "numpy 1.0: install the same there" in wanted


def test_two_flights_in_one_process_are_refused(required: WorkerRequirements) -> None:
    assert "dask worker --nthreads 1 --nworkers 16" in problem_of(required, threads=16)


def test_another_calibration_or_none_is_seen(tmp_path: Path) -> None:
    """The profile is sent; the files that it names are not."""
    shipped = data_file("calib", load_profile("sim").camera.calibration)
    assert shipped is not None
    file = tmp_path / "camera.yaml"
    shutil.copyfile(shipped, file)
    (tmp_path / "mine.yaml").write_text("extends: sim\ncamera: {calibration: camera.yaml}\n")
    with worker_requirements([load_profile(str(tmp_path / "mine.yaml"))], None) as found:
        assert not problem_of(found)
        text = file.read_text()
        focal = str(profile_camera(found.profiles[0][0].camera).K[0, 0])
        assert focal in text
        file.write_text(text.replace(focal, f"{float(focal) + 1.0}"))
        assert problem_of(found).startswith(f"has another {file} for mine")
        file.unlink()
        assert problem_of(found).startswith("cannot fly mine: calibration file")


def test_a_folder_that_is_not_shared_or_cannot_be_written_to_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of the same path on another disk is not the same folder."""
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    ours.mkdir()
    theirs.mkdir()
    with worker_requirements([], ours) as found:
        assert found.mark is not None
        there = replace(found, mark=theirs / found.mark.name)
        assert there.mark is not None
        unseen = f"does not see what this computer writes to {theirs}"
        assert problem_of(there).startswith(unseen)
        there.mark.write_text("of another campaign")
        assert problem_of(there).startswith(unseen)
        shutil.copyfile(found.mark, there.mark)
        assert not problem_of(there)
        assert list(theirs.iterdir()) == [there.mark]

        def full(_path: Path, *_args: object, **_named: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(Path, "touch", full)
        assert problem_of(there).startswith(f"cannot write to {theirs} (No space left on device)")


def test_a_folder_that_nothing_can_be_written_to_here_is_told(tmp_path: Path) -> None:
    with (
        pytest.raises(InvalidValue, match="cannot be written"),
        worker_requirements([], tmp_path / "none"),
    ):
        raise AssertionError


def test_a_profile_is_sent_small() -> None:
    """It goes with each flight."""
    with worker_requirements([Profile()], None) as found:
        assert len(pickle.dumps(found)) < 20_000


def test_one_that_came_later_is_verified_with_its_first_flight(
    required: WorkerRequirements, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = SimpleNamespace(address="tcp://10.0.0.5:4001", state=SimpleNamespace(nthreads=2))
    monkeypatch.setattr(workers, "get_worker", lambda: there)
    order = pickle.dumps((ends_at_once, (1,), {}))
    with pytest.raises(InvalidValue, match=r"^worker tcp://10\.0\.0\.5:4001 on .* flies 2 flights"):
        fly_verified(order, required)
    there.state.nthreads = 1
    with worker_requirements([], None) as other:
        assert isinstance(fly_verified(order, other), Ended)


# --- what a campaign makes of it ----------------------------------------------------------------


class Client:
    """A cluster's scheduler, and its workers, each with what it answers."""

    def __init__(self, answers: dict[str, Any], distributed: str) -> None:
        self._answers, self._distributed = answers, distributed
        self.scheduler = SimpleNamespace(versions=self._versions)

    def sync(self, function: Callable[..., Any], *args: Any, **_named: Any) -> Any:
        return function(*args)

    def _versions(self) -> dict[str, Any]:
        return {"packages": {"distributed": self._distributed}}

    def _run(self, _function: object, _required: WorkerRequirements) -> dict[str, Any]:
        return self._answers


def verified(
    required: WorkerRequirements, distributed: str | None = None, **answers: Any
) -> list[str]:
    own = required.libraries["distributed"]
    return verify_cluster(Client(answers, distributed or own), "here", required)


def test_a_scheduler_of_another_version_is_told(required: WorkerRequirements) -> None:
    """The two would not understand each other, and say so by none answering."""
    with pytest.raises(InvalidValue, match=r"at here has distributed 1\.0, and here it is "):
        verified(required, "1.0")


def test_the_first_that_must_not_fly_is_told_and_how_many_more(
    required: WorkerRequirements,
) -> None:
    bad = WorkerReport("node7", "has numpy 1: install the same there")
    with pytest.raises(InvalidValue, match=r"^worker b on node7 has numpy 1.* \(and 1 more\)$"):
        verified(required, c=bad, b=bad, a=WorkerReport("node1", None, "x"))
    missing = ModuleNotFoundError("No module named 'perchctl'")
    with pytest.raises(InvalidValue, match=r"^worker a cannot load .* the extras sim and cluster"):
        verified(required, a=missing)


def test_one_that_has_gone_meanwhile_stops_nothing(required: WorkerRequirements) -> None:
    assert verified(required, a=fitness(required, 1), b=ConnectionResetError()) == []


def test_another_processor_is_worth_a_note(required: WorkerRequirements) -> None:
    own = fitness(required, 1)
    (note,) = verified(required, a=own, b=replace(own, arithmetic="00000000"))
    assert note.startswith("1 of 2 workers have another processor")


def test_workers_that_hang_are_told(required: WorkerRequirements) -> None:
    client = Client({}, required.libraries["distributed"])

    def hanging(*_args: Any, **_named: Any) -> Any:
        raise TimeoutError

    client.sync = hanging  # type: ignore[method-assign]
    with pytest.raises(ConnectionFailed, match=r"not all workers .* answer within"):
        verify_cluster(client, "here", required)
