"""A campaign's file of results: whole lines, gone on with, and by the same flights only."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.campaign import FlightResult, campaign_results, results_file
from perchctl.campaign.results_file import profile_sha256, source_sha256
from perchctl.errors import InvalidValue
from perchctl.profile import Profile, load_profile
from perchctl.sim import draw_scenario

SIM = load_profile("sim")
SCENARIO = draw_scenario(SIM, 17)
FLOWN = FlightResult(
    0, "perched", "hanging still", 0.1 / 3, 20.0, 1, False, False,
    log=Path("logs/a.jsonl"), cpu_s=4.0, scenario=SCENARIO,
)  # fmt: skip


def written(path: Path, *seeds: int, profile: Profile = SIM, **options: Any) -> list[int]:
    """Fly these seeds into the file, and return those that it had before."""
    every = range(100)
    with campaign_results(profile, every, FlightResult, out=path, **options) as results:
        assert all(replace(FLOWN, seed=earlier.seed) == earlier for earlier in results.earlier)
        assert set(results.remaining) == {*every} - {earlier.seed for earlier in results.earlier}
        for seed in seeds:
            results.write_result(replace(FLOWN, seed=seed))
            last = json.loads(path.read_text().splitlines()[-1])
            assert (last["kind"], last["seed"], last["miss_m"]) == ("flight", seed, 0.1 / 3)
        return [earlier.seed for earlier in results.earlier]


def test_wherever_the_computer_died_it_goes_on(tmp_path: Path) -> None:
    """Of each length that a file may have been cut to."""
    written(tmp_path / "whole.jsonl", 0, 1)
    whole = (tmp_path / "whole.jsonl").read_bytes()
    path = tmp_path / "cut.jsonl"
    ends = [i + 1 for i, byte in enumerate(whole) if byte == ord("\n")]
    near = {end + k for end in (0, 20, *ends) for k in (-1, 0, 1, 30)}
    for length in sorted(near & set(range(len(whole) + 1))):
        path.write_bytes(whole[:length])
        lines = whole[:length].count(b"\n")
        earlier = list(range(max(0, lines - 1)))
        assert written(path, 9, resume=True) == earlier
        assert path.read_bytes().startswith(whole[: whole[:length].rfind(b"\n") + 1])
        assert written(path, resume=True) == [*earlier, 9]


def test_an_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "out.jsonl"
    written(path, 0)
    before = path.read_bytes()
    with pytest.raises(InvalidValue, match="already exists; add --resume to continue it"):
        written(path)
    assert path.read_bytes() == before
    assert written(path, force=True) == written(path, resume=True) == []


def test_other_flights_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "out.jsonl"
    written(path, 0)
    before = path.read_bytes().replace(b'"seed"', b'"number"')  # as others may call it
    path.write_bytes(before)
    with pytest.raises(
        InvalidValue, match="a different profile and a different selection of faults"
    ):
        written(path, profile=load_profile("rough"), faults=["killed"], resume=True)
    monkeypatch.setattr(results_file, "source_sha256", lambda: "ffff")
    with pytest.raises(InvalidValue, match="a different program: "):
        written(path, resume=True, force=True)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("line", "old", "new"),
    [
        (1, b"{", b"my notes\n{"),
        (1, b"perchctl-campaign", b"perchctl-flight-log"),
        (1, b'"version":', b'"version":9'),
        (2, b"{", b"oops{"),
        (2, b'"flight"', b'"header"'),
        (2, b'"seed":0', b'"seed":"a"'),
    ],
)
def test_what_is_no_such_file_is_left_alone(
    line: int, old: bytes, new: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "out.jsonl"
    written(path, 0)
    lines = path.read_bytes().splitlines(keepends=True)
    lines[line - 1] = lines[line - 1].replace(old, new, 1)
    for content in (b"".join(lines), b"my notes"):
        path.write_bytes(content)
        with pytest.raises(InvalidValue, match="not the results of a campaign"):
            written(path, resume=True)
        assert path.read_bytes() == content


def test_a_profile_is_known_by_what_it_flies() -> None:
    named = SIM.model_copy(update={"name": "other", "description": "mine"})
    assert profile_sha256(named) == profile_sha256(SIM)
    camera = SIM.camera.model_copy(update={"latency_s": 0.05})
    assert profile_sha256(SIM.model_copy(update={"camera": camera})) != profile_sha256(SIM)


def test_the_program_is_known_by_its_source(tmp_path: Path) -> None:
    """Whatever its version, and the ends of its lines."""
    texts = (b"a = 1\nb = 2\n", b"a = 1\r\nb = 2\r\n", b"a = 1\nb = 3\n")
    for number, text in enumerate(texts):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "loop.py").write_bytes(text)
    plain, windows, other = (source_sha256(tmp_path / str(number)) for number in range(3))
    assert plain == windows != other


def test_a_result_is_on_the_disk_before_the_next_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power cut costs the flights that were in the air, and none that had ended."""
    path, on_disk = tmp_path / "flown.jsonl", []
    monkeypatch.setattr(os, "fsync", lambda fd: on_disk.append(os.fstat(fd).st_size))
    written(path, 0)
    assert on_disk[-1] == path.stat().st_size
