"""`perchctl simulate`: a campaign, and one flight of it told for people."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.campaign import FlightResult
from perchctl.record import from_exact_json, read_log
from tests.helpers.commands import Said, elsewhere, run, run_apart  # noqa: F401
from tests.helpers.flights import ROOT, SEED, SHORT
from tests.helpers.results import flown_record

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The campaign's."""
    return tmp_path_factory.mktemp("campaign") / "logs"


@pytest.fixture(scope="module")
def campaign(logs: Path) -> Said:
    """Two seeds, two at a time, with their logs."""
    arguments = ("-p", SHORT, "-n", "2", "--seed", str(SEED), "--jobs", "2", "--json")
    out = logs.with_name("out.jsonl")
    return run_apart("simulate", *arguments, "--log-dir", str(logs), "--out", str(out))


def test_simulate_prints_one_object(campaign: Said, logs: Path) -> None:
    assert campaign.code == 0
    said = json.loads(campaign.stdout)
    assert [said[k] for k in ("flights", "perched", "landed", "aborted", "locked", "fell")] == [
        2, 2, 0, 0, 0, 0,
    ]  # fmt: skip
    assert 0 < said["miss_m"]["median"] <= said["miss_m"]["max"] < 0.020
    assert said["worst_seeds"] == []
    assert said["rates"]["perched"] == {"rate": 1.0, "interval": [0.158114, 1.0]}
    assert campaign.complaint == f"the flights' logs are in {logs}"
    assert "\x1b" not in campaign.stdout + campaign.stderr  # a pipe gets no colour


def _lines(path: Path) -> list[dict[str, Any]]:
    """The whole ones."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_bytes().splitlines(True) if line[-1:] == b"\n"]


def test_a_campaign_that_is_killed_goes_on_to_the_same_flights(
    campaign: Said, logs: Path, tmp_path: Path
) -> None:
    """As two processes flew them."""
    out = tmp_path / "out.jsonl"
    asked = ["simulate", "-p", SHORT, "-n", "2", "--seed", str(SEED), "--out", str(out)]
    with subprocess.Popen(
        [sys.executable, "-m", "perchctl", *asked],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
    ) as program:
        end_s = time.monotonic() + 60.0
        while len(_lines(out)) < 2 and time.monotonic() < end_s:
            time.sleep(0.02)
        program.kill()
    assert [line["kind"] for line in _lines(out)] == ["header", "flight"]
    resumed = run_apart(*asked, "--resume", "--json")
    assert resumed.code == 0, resumed.stderr
    figures = json.loads(resumed.stdout)
    assert (figures["flights"], figures["perched"]) == (2, 2)
    flights, others = (
        sorted((flown_record(from_exact_json(FlightResult, r)) for r in _flights(path)), key=_seed)
        for path in (out, logs.with_name("out.jsonl"))
    )
    assert flights == others
    assert [flight["seed"] for flight in flights] == [SEED, SEED + 1]
    again = run_apart(*asked, "--resume", "--json")
    assert json.loads(again.stdout)["miss_m"] == figures["miss_m"]
    assert len(_lines(out)) == 3


def _seed(record: dict[str, Any]) -> int:
    return int(record["seed"])


def _flights(path: Path) -> list[dict[str, Any]]:
    records = [line for line in _lines(path) if line.pop("kind") == "flight"]
    assert all(record["scenario"]["seed"] == record["seed"] for record in records)
    assert all(record["cpu_s"] > 0 for record in records)
    return records


def test_one_seed_is_the_flight_that_it_was_in_the_campaign(
    campaign: Said, logs: Path, tmp_path: Path
) -> None:
    """The same log, from another process."""
    arguments = ("-p", SHORT, "-n", "1", "--seed", str(SEED), "--log-dir", str(tmp_path / "made"))
    said = run_apart("simulate", *arguments, PYTHONHASHSEED="7")
    assert said.code == 0
    name = f"flight_seed{SEED}.jsonl"
    assert (tmp_path / "made" / name).read_bytes() == (logs / name).read_bytes()
    assert sorted(path.name for path in logs.iterdir()) == [name, f"flight_seed{SEED + 1}.jsonl"]
    misses = [read_log(path).summary["miss_m"] for path in logs.iterdir()]  # type: ignore[index]
    assert json.loads(campaign.stdout)["miss_m"]["max"] == pytest.approx(max(misses), abs=1e-6)
