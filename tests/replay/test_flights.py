"""Whole simulated flights, faults included, decided and seen again."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.analysis import replay
from perchctl.analysis.replayer import Replay
from perchctl.campaign import seed_log_path
from perchctl.campaign.flights import fly_seed
from perchctl.faults import FAULTS, fly_fault_in_folder
from perchctl.profile import apply_settings
from perchctl.record import read_log, recorded_pictures
from tests.helpers.flights import short_profile

EVERY_FAULT = tuple(fault.name for fault in FAULTS)
PLAIN, FAULTY, RECORDED = range(10, 35), range(100, 125), range(10)
LEAST_REPLAYED = 23
"""Of the 25 with faults. Today all of them leave turns; a fault that is new to the catalogue makes
the seeds draw others, and one that refuses the flight, or takes the log's disk, leaves none."""


def flown(folder: Path, seed: int, faults: tuple[str, ...] = ()) -> Replay | None:
    """Fly, and decide again; None where the log could not hold the flight, which a fault may
    forbid, or the flight was refused."""
    path = folder / f"flight_seed{seed}.jsonl"
    if faults:
        fly_fault_in_folder(short_profile(), faults, folder, False, seed)
    else:
        fly_seed(short_profile(), seed, path)
    log = read_log(path)
    return replay(log) if log.turn_records else None


def recorded(folder: Path, seed: int) -> Replay:
    """Fly with pictures; decide and see again."""
    path = folder / "f.jsonl"
    fly_seed(short_profile(), seed, path, record=True)
    return replay(read_log(path), recorded_pictures(path))


def check_seen(found: Replay) -> None:
    assert found.seen is not None
    assert (found.differences, found.seen.differences, found.seen.end_reason) == ([], [], "")
    assert found.seen.frames > 50


@pytest.mark.long
@pytest.mark.parametrize("faults", [(), ("hung",), ("external-occluded",)], ids=str)
def test_a_flight_replays(tmp_path: Path, faults: tuple[str, ...]) -> None:
    found = flown(tmp_path, 101, faults)
    assert found is not None
    assert found.is_identical, found.differences
    assert found.ticks > 100


@pytest.mark.long
def test_a_recorded_flight_is_seen_again(tmp_path: Path) -> None:
    check_seen(recorded(tmp_path, 0))
    path = tmp_path / "f.jsonl"
    log = read_log(path)
    nearer = apply_settings(short_profile(), ["vehicle.gear_body_m=[0, 0, 0.031]"])
    found = replay(log, recorded_pictures(path), nearer)
    assert found.changed_keys == ("vehicle.gear_body_m",)
    assert found.differences[0].field.startswith(("command.", "phase"))


@pytest.mark.long
@pytest.mark.parametrize(
    ("positioning", "fault", "seed"),
    [("target", "target-covered", 5), ("mocap", "external-mirrored", 2)],
)
def test_a_landing_without_positions_is_seen_again(
    tmp_path: Path, positioning: str, fault: str, seed: int
) -> None:
    """From when on the sights are not sent, and whether earlier ones were forgotten, decides what
    the planner is shown: both are in the log."""
    profile = apply_settings(short_profile(), [f"positioning.by={positioning}"])
    fly_fault_in_folder(profile, (fault,), tmp_path, True, seed)
    path = seed_log_path(seed, tmp_path)
    log = read_log(path)
    assert any(
        not turn.inputs.sends_sightings_as_position or turn.inputs.has_discarded_sightings
        for turn in log.turns
    )
    check_seen(replay(log, recorded_pictures(path)))


@pytest.mark.campaign
@pytest.mark.parametrize("seed", PLAIN)
def test_seeded_flights_replay(tmp_path: Path, seed: int) -> None:
    found = flown(tmp_path, seed)
    assert found is not None
    assert found.is_identical, found.differences


@pytest.mark.campaign
def test_seeded_flights_with_faults_replay(tmp_path: Path) -> None:
    """Each with one of all faults, in a phase and at a moment of its seed's. Of most there is
    something to replay."""
    replayed = 0
    for seed in FAULTY:
        folder = tmp_path / str(seed)
        folder.mkdir()
        found = flown(folder, seed, EVERY_FAULT)
        assert found is None or found.is_identical, (seed, found.differences)
        replayed += found is not None and found.ticks > 0
    assert replayed >= LEAST_REPLAYED


@pytest.mark.campaign
@pytest.mark.parametrize("seed", RECORDED)
def test_recorded_flights_are_seen_again(tmp_path: Path, seed: int) -> None:
    check_seen(recorded(tmp_path, seed))
