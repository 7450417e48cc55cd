"""`perchctl calibrate mount`: what it refuses, prints, draws and writes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import Result

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl import calibration
from perchctl.calibration import MountingRecording
from perchctl.calibration.mounting.carry import RotationSolution
from perchctl.calibration.mounting.report import MountingReport
from perchctl.geometry import Array
from perchctl.profile import Mounting, load_profile
from tests.helpers.calibrating import calibrate, refused
from tests.helpers.mounting import hand, seen

MINE = """# the one with the long legs
extends: crazyflie
camera:
  latency_s: 0.08  # a guess
  mount:
    rpy_deg: [0, 0, 0]  # as it was built
"""
SEED = 1
KEYS = ("rpy_deg", "latency_s", "gear_cam_m")


def mount(*words: str | Path) -> Result:
    return calibrate("mount", *words)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Recordings of both parts, of each one, and of what will not do."""
    folder = tmp_path_factory.mktemp("logs")
    carry, pivot = seen(hand("carry", SEED)), seen(hand("pivot", SEED))
    still = replace(pivot, attitudes=[], poses=[pivot.poses[0]] * 200)
    mirrored = replace(pivot, attitudes=[], poses=[], mirrored_pictures=200)
    brief = replace(carry, attitudes=carry.attitudes[:300], poses=carry.poses[:40])
    paths = {}
    for name, parts in {
        "both": (carry, pivot), "carry": (carry,), "pivot": (pivot,), "still": (still,),
        "mirrored": (mirrored,), "brief": (brief,),
    }.items():  # fmt: skip
        paths[name] = folder / f"{name}.jsonl"
        MountingRecording.write(paths[name], parts)
    whole = paths["pivot"].read_text(encoding="utf-8")
    paths["cut"] = folder / "cut.jsonl"
    paths["cut"].write_text(whole[: len(whole) // 2], encoding="utf-8")
    return paths


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CFLIB_URI", raising=False)
    (tmp_path / "mine.yaml").write_text(MINE, encoding="utf-8")
    return tmp_path


# --- what it refuses -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        ([], 2, ["-p"]),
        (["-p", "no_such"], 20, ["no_such", "crazyflie"]),
        (["-p", "mine.yaml", "--part", "both sides"], 30, ["--part", "pivot"]),
        (["-p", "mine.yaml", "-u", "nonsense://x"], 30, ["nonsense://x", "radio://"]),
        (["-p", "mine.yaml", "-u", "sim://"], 2, ["you cannot move it", "--part pivot"]),
        (["-p", "sim"], 2, ["sim:", "you cannot move it", "--source"]),
        (["-p", "mine.yaml", "--source", "sim:"], 2, ["name a real one"]),
        (["-p", "mine.yaml", "--source", "video:no.mp4"], 2, ["--part pivot", "clock"]),
        (["-p", "mine.yaml", "--source", "no.mp4"], 20, ["no.mp4"]),
        (["-p", "mine.yaml", "--part", "pivot", "--source", "video:no.mp4"], 20, ["no.mp4"]),
        (["-p", "mine.yaml", "--source", "camera:99"], 20, ["camera:99"]),
        (["-p", "mine.yaml", "--from", "no.jsonl"], 20, ["no.jsonl"]),
        (["-p", "mine.yaml", "--from", "mine.yaml"], 30, ["mine.yaml", "a profile"]),
        (["-p", "mine.yaml", "--from", "."], 30, ["."]),
        (["-p", "crazyflie", "--write"], 30, ["shipped", "cp ", "-p my_"]),
        (["-p", "mine.yaml", "--board", "chessboard:9x6:25mm"], 2, ["--board"]),
    ],
)  # fmt: skip
def test_wrong_usage(place: Path, words: list[str], code: int, expected: list[str]) -> None:
    before = {path: path.read_bytes() for path in place.iterdir()}
    refused(mount(*words), code, *expected)
    assert {path: path.read_bytes() for path in place.iterdir()} == before


@pytest.mark.parametrize(
    ("names", "words", "expected"),
    [
        (["still"], [], ["lacks motion", "tilt"]),
        (["mirrored"], [], ["camera.mirrored"]),
        (["brief", "pivot"], [], ["the carry recording lacks motion"]),
        (["carry"], ["--part", "pivot"], ["no pivot", "only carry"]),
        (["cut"], [], ["cut.jsonl, line"]),
    ],
)
def test_recordings_that_will_not_do(
    place: Path, logs: dict[str, Path], names: list[str], words: list[str], expected: list[str]
) -> None:
    given = [word for name in names for word in ("--from", logs[name])]
    refused(mount("-p", "mine.yaml", *given, *words), 30, *expected)


# --- what it gives -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured(
    logs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Result]:
    """Both parts, measured and written; the folder it was done in."""
    folder = tmp_path_factory.mktemp("measured")
    (folder / "mine.yaml").write_text(MINE, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        words = ["-p", "mine.yaml", "--from", logs["both"], "--write", "--json"]
        return folder, mount(*words)


def test_both_parts_measure_all_and_say_what_was_written_before(
    measured: tuple[Path, Result], logs: dict[str, Path]
) -> None:
    folder, result = measured
    assert result.exit_code == 0, result.stderr
    record = json.loads(result.stdout)
    truth = hand("carry", SEED)
    R = Mounting(rpy_deg=tuple(record["rpy_deg"])).T_body_cam[:3, :3]
    assert np.degrees(Rotation.from_matrix(R.T @ truth.T_body_cam[:3, :3]).magnitude()) < 0.5
    assert record["latency_s"] == pytest.approx(truth.latency_s, abs=0.008)
    assert record["gear_cam_m"] == pytest.approx(truth.gear_cam_m, abs=0.0012)
    assert set(record["sigma"]) == set(record["written"]) == set(KEYS)
    assert record["written"]["rpy_deg"] == [0.0, 0.0, 0.0]
    assert record["recordings"] == [str(logs["both"])]
    assert "the profile has 0 0 0: " in result.stderr
    assert "deg off" in result.stderr
    assert [path.name for path in folder.iterdir() if path.suffix not in (".yaml", ".bak")] == []


def test_write_puts_the_numbers_into_the_profile_and_keeps_its_comments(
    measured: tuple[Path, Result],
) -> None:
    folder, result = measured
    record = json.loads(result.stdout)
    text = (folder / "mine.yaml").read_text(encoding="utf-8")
    assert [line.partition("#")[2] for line in MINE.splitlines() if "#" in line] == [
        line.partition("#")[2] for line in text.splitlines() if "#" in line
    ]
    assert Path(record["profile_before"]).read_text(encoding="utf-8") == MINE
    assert Path(record["profile_before"]).parent == Path(record["profile"]).parent
    profile = load_profile(str(folder / "mine.yaml"))
    assert list(profile.camera.mount.rpy_deg) == pytest.approx(record["rpy_deg"], abs=0.005)
    assert profile.camera.latency_s == pytest.approx(record["latency_s"], abs=5e-5)
    # What a flight rests on: the tip from the camera, in the camera's axes.
    written = MountingReport(profile, None, None).profile_gear_cam_m
    assert written == pytest.approx(record["gear_cam_m"], abs=3e-5)


def test_the_pivot_alone_leaves_the_turn_open(place: Path, logs: dict[str, Path]) -> None:
    result = mount("-p", "mine.yaml", "--from", logs["pivot"], "--json")
    record = json.loads(result.stdout)
    assert list(record["sigma"]) == list(record["written"]) == ["gear_cam_m"]
    assert list(record["profile_values"]) == ["vehicle.gear_body_m"]


@pytest.mark.parametrize("changed", ["camera: {latency_s: measured}", None])
def test_a_profile_that_was_changed_meanwhile_is_not_written_to(
    place: Path, logs: dict[str, Path], monkeypatch: pytest.MonkeyPatch, changed: str | None
) -> None:
    """A gear by the old turn beside a new one would be a gear in another place. The numbers are
    printed all the same, also where the profile (None) is gone."""
    mine, text = Path("mine.yaml"), f"extends: crazyflie\n{changed}\n"
    mine.write_text("extends: crazyflie\n", encoding="utf-8")
    solved = calibration.solve_mounting

    def long_work(*given: Any) -> Any:
        mine.unlink() if changed is None else mine.write_text(text, encoding="utf-8")
        return solved(*given)

    monkeypatch.setattr(calibration, "solve_mounting", long_work)
    result = mount("-p", "mine.yaml", "--from", str(logs["pivot"]), "--write")
    assert result.exit_code == (20 if changed is None else 30), result.stderr
    assert result.stdout.startswith("vehicle.gear_body_m: [")
    if changed is not None:
        assert mine.read_text(encoding="utf-8") == text


def test_numbers_that_cannot_be_written_are_still_reported(
    place: Path, logs: dict[str, Path]
) -> None:
    odd = "extends: crazyflie\ncamera: {mount: {position_m: &a [0, 0, 0]}}\n"
    odd += "vehicle: {gear_body_m: *a}\n"
    Path("odd.yaml").write_text(odd, encoding="utf-8")
    result = mount("-p", "odd.yaml", "--from", logs["pivot"], "--write")
    assert result.exit_code == 30
    assert "write the values by hand: vehicle.gear_body_m: [" in result.stderr
    assert result.stdout.startswith("vehicle.gear_body_m: [")
    assert Path("odd.yaml").read_text(encoding="utf-8") == odd


def test_a_latency_that_flights_measure_stays_so() -> None:
    profile = load_profile("crazyflie")
    camera = profile.camera.model_copy(update={"latency_s": "measured"})
    c = MountingReport(profile.model_copy(update={"camera": camera}), carried(np.eye(3)), None)
    assert "camera.latency_s" not in c.new_profile_values()
    assert "latency_s" not in c.record()["written"]
    assert "the profile keeps `measured`" in "\n".join(c.lines())


def carried(R: Array) -> RotationSolution:
    """A solution with that turn."""
    known = np.eye(3) * np.radians(0.05) ** 2
    return RotationSolution(R, known, 0.0803, 0.001)
