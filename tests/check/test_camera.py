"""Each fault that the simulated camera can have makes its row fail or warn; in lockstep, so that
no time of the computer's decides."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.calibration import profile_camera
from perchctl.check import Row, Verdict, camera
from perchctl.check import profile as of_profile
from perchctl.check.rehearsal import PictureProblem, Rehearsal, rehearse
from perchctl.check.row import Finding, evaluate_row
from perchctl.errors import NotFound, TimedOut
from perchctl.faults.edges import CameraFault, FaultyCamera
from perchctl.faults.effects import FOR_EVER
from perchctl.flight.lockstep import LockstepClock, LockstepSource
from perchctl.link import MockLink
from perchctl.profile import Profile, load_profile
from perchctl.sim import Scenario, SimulatedVehicle
from perchctl.vehicle import Telemetry
from perchctl.vision import make_pipeline
from tests.helpers.mission import target_at

PROFILE = load_profile("sim")
CAMERA = profile_camera(PROFILE.camera)
PIPELINE = make_pipeline(PROFILE, CAMERA)
NEAR_M = 0.45
"""From the gear to the target: both markers are seen."""
FAR_FOR_BOTH_M = 1.4


@pytest.fixture(autouse=True, scope="module")
def _one_core() -> Iterator[None]:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)


class Stopwatch:
    """Each turn's work takes so long."""

    def __init__(self, work_s: float) -> None:
        self._work_s, self._now_s, self._odd = work_s, 0.0, False

    def __call__(self) -> float:
        self._now_s, self._odd = self._now_s + self._work_s * self._odd, not self._odd
        return self._now_s


def rehearsed(
    fault: CameraFault | None = None,
    away_m: float = NEAR_M,
    duration_s: float = 0.4,
    felt: Callable[[Telemetry], Telemetry] = lambda sample: sample,
    **scenario: Any,
) -> Rehearsal:
    """On the pictures of a vehicle that is held under the target; `felt` changes its telemetry."""
    changed = {"camera_noise_sigma": 4.0, "camera_jitter_s": 0.002} | scenario
    vehicle = SimulatedVehicle(Scenario(**changed), CAMERA, PROFILE.target)
    z_m = vehicle.scenario.ceiling_z_m - away_m - 0.03
    vehicle.world.set_pose((0.0, 0.0, z_m), hold=True)
    link = MockLink(vehicle)
    link.advance_to(0.3)
    source = FaultyCamera(LockstepSource(vehicle, PROFILE.camera.latency_s), seed=1)
    if fault is not None:
        source.begin_fault(fault, 0.4)
    clock = LockstepClock(link)

    def take() -> list[Telemetry]:
        return [felt(sample) for sample in link.telemetry()]

    return rehearse(take, source, PIPELINE, PROFILE, clock, duration_s, Stopwatch(0.005))


def rows_of(done: Rehearsal, profile: Profile = PROFILE) -> dict[str, Row]:
    found = camera.picture_rows(done, profile, CAMERA)
    assert [row.name for row in found] == list(camera.picture_row_names(profile))
    loop = evaluate_row("loop", camera.loop_finding, done, profile)
    return {row.name: row for row in [*found, loop]}


FAULTS: dict[str, dict[str, Any]] = {
    "none": {"duration_s": 0.6},
    "frozen": {"fault": CameraFault("frozen", FOR_EVER), "duration_s": 0.8},
    "snow": {"fault": CameraFault("snow", FOR_EVER)},
    "dark": {"fault": CameraFault("dark", FOR_EVER)},
    "mirrored": {"fault": CameraFault("mirrored", FOR_EVER)},
    "lossy, and a wrong print": {"camera_drop_rate": 0.35, "small_side_m": 0.024,
                                 "duration_s": 0.8},
    "slow": {"camera_rate_hz": 6.0, "duration_s": 0.8},
    "out of focus": {"camera_defocus_px": 3.2},
    "bare": {"no_target": True},
    "silent": {"fault": CameraFault("silent", FOR_EVER), "duration_s": 0.8},
    "out of order": {"fault": CameraFault("out-of-order", FOR_EVER)},
}  # fmt: skip


@cache
def shown(fault: str) -> tuple[Rehearsal, dict[str, Row]]:
    done = rehearsed(**FAULTS[fault])
    return done, rows_of(done)


def good() -> tuple[Rehearsal, dict[str, Row]]:
    return shown("none")


def test_a_good_camera_fails_nothing() -> None:
    _, rows = good()
    assert [row for row in rows.values() if row.verdict in ("warn", "fail", "skipped")] == []
    assert "0.45 m from the gear" in rows["target"].found


@pytest.mark.parametrize(("fault", "name", "verdict", "words"), [
    ("frozen", "pictures", "fail", "is frozen"),
    ("mirrored", "pictures", "fail", "mirrored"),
    ("lossy, and a wrong print", "print", "fail", "print error"),
    ("bare", "target", "skipped", "not detected"),
    *(pytest.param(*each, marks=pytest.mark.long) for each in (
        ("snow", "pictures", "fail", "snow"),
        ("dark", "pictures", "fail", "dark"),
        ("slow", "frame rate", "fail", "6 Hz"),
        ("out of focus", "focus", "fail", "blur sigma 3"),
        ("silent", "lost frames", "fail", "no picture for the last 0."),
        ("out of order", "pictures", "fail", "arrived after newer ones"),
    )),
])  # fmt: skip
def test_a_fault_of_the_simulated_camera_makes_its_row(
    fault: str, name: str, verdict: str, words: str
) -> None:
    row = shown(fault)[1][name]
    assert row.verdict == verdict, row
    assert words in row.found
    assert row.advice
    assert good()[1][name].verdict is Verdict.PASS


def test_what_a_target_would_show_is_not_known_without_one() -> None:
    for name in ("target", "focus", "print"):
        assert shown("bare")[1][name].verdict is Verdict.SKIPPED, name
    far = rehearsed(away_m=FAR_FOR_BOTH_M, duration_s=0.2)
    assert rows_of(far)["print"].verdict is Verdict.SKIPPED, "both markers are needed"


def test_a_camera_that_falls_silent_at_once_fails_and_nothing_passes() -> None:
    rows = rows_of(rehearsed(CameraFault("silent", FOR_EVER), duration_s=0.0))
    assert rows["frame rate"].verdict is Verdict.FAIL
    assert {r.verdict for r in rows.values() if r.name != "frame rate"} == {Verdict.SKIPPED}


# --- Rows by figures --------------------------------------------------------------------


def altered(**changes: Any) -> Rehearsal:
    """The good rehearsal with other figures."""
    return replace(good()[0], **changes)


def gaps(*gaps_s: float) -> list[tuple[int, float]]:
    t_s, out = 0.0, [(0, 0.0)]
    for number, gap_s in enumerate(gaps_s, start=1):
        t_s += gap_s
        out.append((number, t_s))
    return out


@pytest.mark.parametrize(("name", "verdict", "changes"), [
    ("lost frames", "fail", {"arrivals": gaps(*[0.03] * 20, 0.7)}),
    ("lost frames", "warn", {"arrivals": gaps(*[0.03] * 20, 0.3)}),
    ("lost frames", "skipped", {"arrivals": gaps(0.03, 0.03)}),
    ("lost frames", "skipped", {"live": False}),
    ("frame rate", "warn", {"arrivals": gaps(*[0.08] * 20)}),
    ("frame rate", "skipped", {"live": False}),
    ("picture age", "warn", {"ages_s": [0.3] * 20}),
    ("picture age", "fail", {"ages_s": [0.5] * 20}),
    ("picture age", "skipped", {"live": False}),
    ("pictures", "warn", {"problems": Counter({PictureProblem("snow", "snow"): 2})}),
    ("pictures", "pass", {"repeats": 100}),
    ("focus", "warn", {"blur_px": 2.0}),
    ("target", "warn", {"target_pictures": 3, "target": None}),
    ("target", "fail", {"target": target_at(1.0, (0.0, 0.0, 0.23), (0.0, 0.0, 0.0))}),
    ("loop", "warn", {"processing_s": [0.028] * 20}),
    ("loop", "fail", {"processing_s": [0.050] * 20}),
    ("loop", "warn", {"tick_delays_s": [0.0] * 90 + [0.02] * 10}),
    ("loop", "fail", {"tick_delays_s": [0.0] * 99 + [0.3]}),
    ("loop", "skipped", {"processing_s": [0.01] * 5}),
    ("loop", "skipped", {"live": False}),
])  # fmt: skip
def test_figures_make_their_row(name: str, verdict: str, changes: dict[str, Any]) -> None:
    done = altered(**changes)
    assert rows_of(done)[name].verdict == verdict


def test_what_a_receiver_gives_out_again_is_counted_once() -> None:
    done = rehearsed(duration_s=0.8, camera_rate_hz=25.0, camera_receiver_hz=60.0)
    assert done.repeats >= 10
    rows = rows_of(done)
    assert rows["pictures"].verdict is Verdict.PASS
    assert "pictures that the receiver repeated" in rows["pictures"].found
    assert 23.0 < float(rows["frame rate"].found.split()[0]) < 27.5
    assert rows["lost frames"].verdict in (Verdict.PASS, Verdict.SKIPPED)
    assert done.target_pictures == done.pictures, "nor does it make the target seem unseen"


@pytest.mark.parametrize(("finding", "verdict", "words"), [
    (camera.size_finding((320, 240), (640, 480)), "fail", "320x240"),
    (camera.size_finding((640, 480), (640, 480)), "pass", "640x480"),
])  # fmt: skip
def test_what_a_camera_delivers_otherwise_makes_its_row(
    finding: Finding, verdict: str, words: str
) -> None:
    assert finding.verdict == verdict
    assert words in finding.found


@pytest.mark.parametrize(("source", "error", "advice"), [
    ("camera:7", NotFound("it was not found; there is none", "plug it in"), "plug it in"),
    ("http://x", NotFound("no answer"), "see docs/check.md"),
    ("camera:0", NotFound("it cannot be opened"), "--cameras lists"),
])  # fmt: skip
def test_a_missing_camera_skips_the_rest(source: str, error: NotFound, advice: str) -> None:
    first, *rest = camera.failed_camera_rows(error, source, PROFILE)
    assert (first.name, first.verdict, first.found) == ("camera", Verdict.FAIL, error.found)
    assert advice in first.advice
    assert source == "camera:0" or "--cameras" not in first.advice
    assert {r.verdict for r in rest} == {Verdict.SKIPPED}


@pytest.mark.parametrize(("scheme", "gone", "lossy"), [
    ("camera", "plug", "receiver"), ("aideck", "switch the Crazyflie off", "the deck"),
    ("http", "switch the camera off", "network"), ("sim", "start it again", "close other"),
])  # fmt: skip
def test_the_advice_fits_the_kind_of_source(scheme: str, gone: str, lossy: str) -> None:
    """An AI-deck has no receiver, and a simulated camera no cable."""
    silent, nothing = altered(scheme=scheme, silent_s=2.0), Rehearsal(live=True, scheme=scheme)
    assert gone in rows_of(silent)["lost frames"].advice
    assert gone in rows_of(nothing)["frame rate"].advice
    late = altered(scheme=scheme, arrivals=gaps(*[0.03] * 20, 0.7))
    assert lossy in rows_of(late)["lost frames"].advice


def test_the_advice_of_an_error_is_the_row_s() -> None:
    error = TimedOut(
        "aideck://x: no first frame: connected", "switch it off and on", separator=": "
    )
    assert str(error) == "aideck://x: no first frame: connected: switch it off and on"
    first, *_ = camera.failed_camera_rows(error, "aideck://x", PROFILE)
    assert first.found == "aideck://x: no first frame: connected"
    assert first.advice == "switch it off and on"


# --- The rehearsal itself, and the computer ---------------------------------------------


def test_a_target_has_a_place_only_while_the_vehicle_stands() -> None:
    """A vehicle in a hand moves, and the target does not: nothing is said against it."""
    done, _ = good()
    first_s, last_s = done.target_places[0][0], done.target_places[-1][0]
    lifted_s = 0.5 * (first_s + last_s)

    def carried(sample: Telemetry) -> Telemetry:
        return replace(sample, acc_z_g=1.3) if lifted_s < sample.t_s < lifted_s + 0.1 else sample

    later = rehearsed(**FAULTS["none"], felt=carried)
    assert later.target_pictures == done.target_pictures
    assert lifted_s < later.target_places[0][0] < later.target_places[-1][0]
    in_hand = rehearsed(**FAULTS["none"], felt=lambda sample: replace(sample, acc_z_g=1.3))
    assert not in_hand.target_places


def test_a_rehearsal_needs_no_vehicle() -> None:
    """Nor can it send anything: telemetry is all that it gets of one."""
    vehicle = SimulatedVehicle(Scenario(), CAMERA, PROFILE.target)
    clock = LockstepClock(MockLink(vehicle))
    source = LockstepSource(vehicle, 0.07)
    done = rehearse(list, source, PIPELINE, PROFILE, clock, 0.3, time.perf_counter)
    assert done.pictures > 3


def test_the_log_s_folder_is_not_made_and_a_file_in_its_place_fails(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    assert of_profile.log_finding(folder).verdict is not Verdict.FAIL
    assert not (tmp_path / "a").exists()
    (tmp_path / "taken").write_text("")
    row = of_profile.log_finding(tmp_path / "taken")
    assert (row.verdict, "is a file" in row.found) == (Verdict.FAIL, True)


@pytest.mark.parametrize(("free", "verdict"), [
    (10_000_000, "fail"), (200_000_000, "warn"), (5_000_000_000, "pass"),
])  # fmt: skip
def test_a_full_disk_makes_its_row(
    free: int, verdict: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        of_profile.shutil, "disk_usage", lambda path: SimpleNamespace(free=free, total=10**12)
    )
    assert of_profile.log_finding(tmp_path).verdict == verdict
