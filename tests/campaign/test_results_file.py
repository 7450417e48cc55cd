"""A campaign's file of results: whole lines, gone on with, and by the same flights only."""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.campaign import FlightResult
from perchctl.campaign.results_file import (
    CampaignResults,
    campaign_header,
    campaign_results,
    commit_of,
    flown_record,
    open_results,
    profile_sha256,
    result_from,
    result_record,
    source_sha256,
)
from perchctl.errors import InvalidValue
from perchctl.faults import FAULTS, FaultResult
from perchctl.faults.catalogue import draw_case
from perchctl.faults.flight import _parameters
from perchctl.profile import load_profile
from perchctl.record.write import recording_path
from perchctl.sim import draw_scenario
from tests.helpers.flights import SHORT
from tests.helpers.results import landed

SIM = load_profile("sim")
HEADER = campaign_header(SIM) | {"profile_sha256": "0123456789", "source": "0a0b0c0d0e"}
FLOWN = FlightResult(0, "perched", "hanging still", 0.1 / 3, 20.0, 1, False, False, 5.0)


def _written(path: Path, *seeds: int, header: dict[str, Any] = HEADER) -> Path:
    results = open_results(path, header, FlightResult)
    for seed in seeds:
        results.append(replace(FLOWN, seed=seed))
    results.close()
    return path


def _resumed(path: Path, header: dict[str, Any] = HEADER, force: bool = False) -> list[int]:
    results = open_results(path, header, FlightResult, resume=True, force=force)
    try:
        assert all(replace(FLOWN, seed=seed) == r for seed, r in results.earlier.items())
        return sorted(results.earlier)
    finally:
        results.close()


def test_each_line_is_in_the_file_as_it_comes(tmp_path: Path) -> None:
    path = tmp_path / "made" / "out.jsonl"
    results = open_results(path, HEADER, FlightResult)
    for seed in (4, 2):
        results.append(replace(FLOWN, seed=seed))
        last = json.loads(path.read_text().splitlines()[-1])
        assert (last["kind"], last["seed"], last["miss_m"]) == ("flight", seed, 0.1 / 3)
    results.close()
    first = json.loads(path.read_text().splitlines()[0])
    assert (first["kind"], first["format"], first["version"]) == ("header", "perchctl-campaign", 1)
    assert _resumed(path) == [2, 4]


def test_wherever_the_computer_died_it_goes_on(tmp_path: Path) -> None:
    """Of each length that a file may have been cut to."""
    whole = _written(tmp_path / "whole.jsonl", 0, 1).read_bytes()
    path = tmp_path / "cut.jsonl"
    ends = [i + 1 for i, byte in enumerate(whole) if byte == ord("\n")]
    near = {end + k for end in (0, 20, *ends) for k in (-1, 0, 1, 30)}
    for length in sorted(near & set(range(len(whole) + 1))):
        path.write_bytes(whole[:length])
        lines = whole[:length].count(b"\n")
        assert _resumed(path) == list(range(max(0, lines - 1)))
        results = open_results(path, HEADER, FlightResult, resume=True)
        results.append(replace(FLOWN, seed=9))
        results.close()
        assert path.read_bytes().startswith(whole[: whole[:length].rfind(b"\n") + 1])
        assert _resumed(path) == [*range(max(0, lines - 1)), 9]


def test_an_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    path = _written(tmp_path / "out.jsonl", 0)
    before = path.read_bytes()
    with pytest.raises(InvalidValue, match="exists already; add --resume to go on with it"):
        open_results(path, HEADER, FlightResult)
    assert path.read_bytes() == before
    open_results(path, HEADER, FlightResult, force=True).close()
    assert _resumed(path) == []


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (
            {"profile_sha256": "9876543210"},
            "another profile .* 01234567; this campaign has .* 987654",
        ),
        ({"faults": ["killed"]}, "other faults .no faults; this campaign has killed"),
        ({"source": "ffffffffff"}, "another program .its source is 0a0b0c0d, and here it is ffff"),
    ],
)
def test_other_flights_are_refused(other: dict[str, Any], words: str, tmp_path: Path) -> None:
    path = _written(tmp_path / "out.jsonl", 0)
    before = path.read_bytes()
    header = HEADER | other
    with pytest.raises(InvalidValue, match=words):
        _resumed(path, header)
    assert path.read_bytes() == before
    if "source" in other:
        assert _resumed(path, header, force=True) == [0]
        assert _resumed(path, header) == [0]
        assert len(path.read_text().splitlines()) == 3


def test_what_is_no_such_file_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "out.jsonl"
    whole = _written(tmp_path / "whole.jsonl", 0, 1).read_bytes().splitlines(keepends=True)
    for content, words in (
        (b"my notes", "holds no campaign's results"),
        (b'{"kind":"header","format":"perchctl-flight-log"}\n', "holds no campaign's results"),
        (whole[0] + b"oops\n" + whole[1], "line 2: no line of a campaign's results"),
        (whole[0] + b'{"kind":"flight","seed":0}\n', "line 2"),
        (whole[0].replace(b'"version":1', b'"version":9'), "version 9, this perchctl reads 1"),
    ):
        path.write_bytes(content)
        with pytest.raises(InvalidValue, match=words):
            _resumed(path)
        assert path.read_bytes() == content


def test_two_campaigns_do_not_write_one_file(tmp_path: Path) -> None:
    path = tmp_path / "out.jsonl"
    results = open_results(path, HEADER, FlightResult)
    for force in (False, True):
        with pytest.raises(InvalidValue, match="is being written by another campaign"):
            open_results(path, HEADER, FlightResult, resume=True, force=force)
    results.close()
    assert _resumed(path) == []


def test_a_profile_is_known_by_what_it_flies() -> None:
    named = SIM.model_copy(update={"name": "other", "description": "mine"})
    assert profile_sha256(named) == profile_sha256(SIM)
    camera = SIM.camera.model_copy(update={"latency_s": 0.05})
    assert profile_sha256(SIM.model_copy(update={"camera": camera})) != profile_sha256(SIM)
    assert campaign_header(SIM, ["killed"])["faults"] == ["killed"]


def test_the_program_is_known_by_its_source(tmp_path: Path) -> None:
    """Whatever its version; its commit is named for people."""
    assert commit_of(tmp_path) is None
    (tmp_path / "flight").mkdir()
    module = tmp_path / "flight" / "loop.py"
    module.write_bytes(b"a = 1\nb = 2\n")
    here = source_sha256(tmp_path)
    module.write_bytes(b"a = 1\r\nb = 2\r\n")
    assert source_sha256(tmp_path) == here
    module.write_bytes(b"a = 1\nb = 3\n")
    assert source_sha256(tmp_path) != here

    def git(*words: str) -> None:
        who = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
        subprocess.run(["git", "-C", str(tmp_path), *who, *words], check=True, capture_output=True)

    git("init")
    assert commit_of(tmp_path) is None
    git("add", ".")
    git("commit", "-m", "a")
    commit = commit_of(tmp_path)
    assert commit is not None
    assert len(commit) == 40
    module.write_bytes(b"")
    assert commit_of(tmp_path) == f"{commit}-dirty"


def test_a_result_is_on_the_disk_before_the_next_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power cut costs the flights that were in the air, and none that had ended."""
    path, on_disk = tmp_path / "flown.jsonl", []
    monkeypatch.setattr(os, "fsync", lambda fd: on_disk.append(os.fstat(fd).st_size))
    results = open_results(path, HEADER, FlightResult)
    results.append(FLOWN)
    assert on_disk[-1] == path.stat().st_size
    results.close()


def test_logs_of_good_flights_go_with_their_recordings(tmp_path: Path) -> None:
    for failed_logs_only, kept in ((False, {0, 1, 2}), (True, {1, 2})):
        folder = tmp_path / f"{failed_logs_only}"
        folder.mkdir()
        results: CampaignResults[FlightResult] = CampaignResults(
            range(3), failed_logs_only=failed_logs_only
        )
        for seed in range(3):
            log = folder / f"flight_seed{seed}.jsonl"
            log.touch()
            recording_path(log).touch()
            flown = landed(seed) if seed == 1 else replace(FLOWN, seed=seed, fell=seed == 2)
            results.note(replace(flown, log=log))
        logs = {folder / f"flight_seed{seed}.jsonl" for seed in kept}
        assert set(folder.iterdir()) == logs | {recording_path(log) for log in logs}


def test_seeds_that_the_file_has_are_not_flown_again(tmp_path: Path) -> None:
    with campaign_results(SIM, range(2), FlightResult, out=tmp_path / "out.jsonl") as results:
        assert results.left == [0, 1]
        results.note(replace(FLOWN, seed=1))
    again = campaign_results(SIM, range(3), FlightResult, out=tmp_path / "out.jsonl", resume=True)
    with again as results:
        assert results.left == [0, 2]
        assert [result.seed for result in results.earlier] == [1]


# --- one result as a record --------------------------------------------------------------------

SCENARIO = draw_scenario(SIM, 17)
WHOLE = FlightResult(
    17, "perched", "hanging still", 0.1 / 3, 20.0, 1, False, False, 5.0 / 3,
    Path("logs/a.jsonl"), None, 4.0, 200.0, SCENARIO,
)  # fmt: skip
FAULTY = FaultResult(
    3, "killed", "SEARCH", 0.3, None, {"Kill": {"at": [1.0, "a"]}}, "gone", "", "killed",
    {"fell": 1.25, "lied": 2.0}, ("lied",), None, 12.0, None, 0.1, way=("SEARCH", "ALIGN"),
)  # fmt: skip


def _read_back(record: dict[str, object]) -> dict[str, object]:
    read = json.loads(json.dumps(record, allow_nan=False))
    assert isinstance(read, dict)
    return read


@pytest.mark.parametrize("result", [WHOLE, replace(WHOLE, miss_m=None, log=None, scenario=None)])
def test_a_flight_comes_back(result: FlightResult) -> None:
    record = _read_back(result_record(result))
    assert result_from(record) == result
    assert record["seed"] == 17
    assert record["timings"] == {
        "realtime_factor": 5.0 / 3, "cpu_s": 4.0, "peak_memory_mb": 200.0,
    }  # fmt: skip


def test_a_flight_with_a_fault_comes_back() -> None:
    assert result_from(_read_back(result_record(FAULTY)), FaultResult) == FAULTY


def test_each_fault_has_parameters_with_a_form() -> None:
    scenario = draw_scenario(load_profile(SHORT), 1)
    for fault in FAULTS:
        for seed in range(4):
            parameters = _parameters(draw_case(seed, scenario, [fault]))
            result = replace(FAULTY, parameters=parameters)
            assert result_from(_read_back(result_record(result)), FaultResult) == result


def test_what_a_computer_measured_is_not_the_flight() -> None:
    elsewhere = replace(WHOLE, realtime_factor=9.0, cpu_s=1.0, peak_memory_mb=9.0, log=None)
    assert flown_record(elsewhere) == flown_record(WHOLE)
    assert flown_record(replace(WHOLE, miss_m=0.1)) != flown_record(WHOLE)
    moved = replace(SCENARIO, mass_kg=0.05)
    assert flown_record(replace(WHOLE, scenario=moved)) != flown_record(WHOLE)


def test_what_is_no_result_is_refused() -> None:
    record = result_record(WHOLE)
    for wrong in (
        {},
        {**record, "outcome": "lost"},
        {**record, "more": 1},
        {**record, "timings": 1},
    ):
        with pytest.raises(ValueError, match=r"needed|none of|no field|missing"):
            result_from(wrong)
