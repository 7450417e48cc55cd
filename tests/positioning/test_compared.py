"""What a hand found of a motion capture is kept, and a flight goes by nothing else."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from perchctl.check import Verdict
from perchctl.check.capture import save_comparison_row
from perchctl.check.row import failed, passed, skipped, warned
from perchctl.commands import app
from perchctl.errors import SafetyAbort
from perchctl.flight import session
from perchctl.positioning import compared
from perchctl.positioning.compared import CaptureComparison
from perchctl.profile import PositioningConfig
from tests.helpers.capture import compared as was_compared

CONFIG = PositioningConfig(by="mocap", host="lab", body="cf2")
NOW = datetime(2026, 11, 22, 15, 0, tzinfo=timezone(timedelta(hours=2)))
URI, VEHICLE = "udp://127.0.0.1:1", "udp/127.0.0.1:1"
SWAPPED = "swapped axes: up is y in the motion-capture system"
DAY_S = 24 * 3600.0
OTHERS: list[dict[str, Any]] = [
    {"system": "vrpn"}, {"host": "lab2"}, {"body": "cf3"}, {"body_rpy_deg": (0.0, 0.0, 90.0)},
    {"body_position_m": (0.0, 0.0, 0.02)},
]  # fmt: skip


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(compared, "user_folder", lambda kind: tmp_path / "state")
    return tmp_path / "state"


def ago(seconds: float, passes: bool = True, found: str = "fine") -> CaptureComparison:
    return CaptureComparison(
        set_up={}, at=NOW - timedelta(seconds=seconds), passed=passes, found=found
    )


def require(config: PositioningConfig = CONFIG, uri: str = URI) -> None:
    """What a flight asks first."""
    session.require_lift_check(config, uri, simulated=False)


# --- The judgement -----------------------------------------------------------------------


@given(st.floats(-1e8, 1e8), st.booleans())
def test_only_a_pass_of_the_last_day_is_flown_by(seconds: float, passes: bool) -> None:
    allowed = passes and -compared.CLOCK_ADJUSTMENT_S <= seconds <= DAY_S
    at = ago(seconds).at
    assert at is not None
    age_s = (NOW - at).total_seconds()  # of whole microseconds
    if min(abs(age_s - DAY_S), abs(age_s + compared.CLOCK_ADJUSTMENT_S)) > 1e-3:
        found, _ = ago(seconds, passes).objection_and_advice(NOW) or ("", "")
        assert (found == "", "in the future" in found) == (
            allowed,
            passes and age_s < -compared.CLOCK_ADJUSTMENT_S,
        )


# --- The record --------------------------------------------------------------------------


@settings(max_examples=20)  # each is written to the disk
@given(st.text(), st.booleans(), st.datetimes(datetime(2001, 1, 1), datetime(2900, 1, 1)))
def test_what_is_written_is_read(found: str, passes: bool, at: datetime) -> None:
    at = at.replace(tzinfo=UTC)
    assert compared.save_comparison(CONFIG, VEHICLE, at, passes, found) is None
    back = compared.load_comparison(CONFIG, VEHICLE)
    assert (back.at, back.passed, back.found) == (at, passes, found)


@pytest.mark.parametrize("how", ["cut", "no zone", "folder"])
def test_a_damaged_record_refuses_in_one_sentence(how: str) -> None:
    was_compared(CONFIG, URI)
    require()
    path = compared.comparison_path(CONFIG, VEHICLE)
    whole = path.read_text(encoding="utf-8")
    path.unlink()
    if how == "folder":
        path.mkdir()
    else:
        path.write_text(whole[:40] if how == "cut" else whole.replace('Z"', '"'), encoding="utf-8")
    with pytest.raises(SafetyAbort, match="never been compared") as refused:
        require()
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("change", "vehicle"), [
    *((change, VEHICLE) for change in OTHERS), ({}, "udp/127.0.0.1:2"),
])  # fmt: skip
def test_another_set_up_or_vehicle_was_never_compared(
    change: dict[str, Any], vehicle: str, folder: Path
) -> None:
    was_compared(CONFIG, URI)
    other = CONFIG.model_copy(update=change)
    assert compared.load_comparison(other, vehicle).at is None
    # Nor by a file that was copied to its place.
    mine, theirs = (
        compared.comparison_path(CONFIG, VEHICLE),
        compared.comparison_path(other, vehicle),
    )
    theirs.write_bytes(mine.read_bytes())
    assert compared.load_comparison(other, vehicle).at is None


def test_what_says_nothing_of_the_axes_and_another_dongle_are_no_other_set_up() -> None:
    was_compared(CONFIG, "radio://0/80/2M/E7E7E7E701")
    same = CONFIG.model_copy(update={"rate_hz": 50.0, "send": "pose", "hold_s": 0.2})
    require(same, "radio://1/80/2M/e7e7e7e701")
    with pytest.raises(SafetyAbort, match="never been compared with this vehicle"):
        require(CONFIG, "radio://0/80/2M/E7E7E7E702")


# --- `check` -----------------------------------------------------------------------------


@pytest.mark.parametrize("lifted", [
    failed(SWAPPED, ""), warned("about too few axes to tell all", ""),
])  # fmt: skip
def test_what_did_not_pass_ends_an_older_pass(lifted: Any) -> None:
    was_compared(CONFIG, URI)
    row = save_comparison_row(lifted, CONFIG, URI, datetime.now().astimezone())
    assert row.verdict is Verdict.WARN
    with pytest.raises(SafetyAbort, match=lifted.found):
        require()
    for again in (passed("fine"), skipped("the vehicle was not moved")):  # which takes no pass away
        assert (
            save_comparison_row(again, CONFIG, URI, datetime.now().astimezone()).verdict
            is Verdict.PASS
        )
    require()


@pytest.mark.parametrize(("lifted", "removable", "verdict"), [
    (passed("fine"), True, Verdict.WARN), (failed(SWAPPED, ""), True, Verdict.WARN),
    (failed(SWAPPED, ""), False, Verdict.FAIL),
])  # fmt: skip
def test_an_unwritten_finding_leaves_no_older_pass_unsaid(
    lifted: Any, removable: bool, verdict: Verdict, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    if lifted.verdict is Verdict.FAIL:
        was_compared(CONFIG, URI)
    monkeypatch.setattr(compared, "write_files", full)
    if not removable:
        monkeypatch.setattr(Path, "unlink", full)
    row = save_comparison_row(lifted, CONFIG, URI, datetime.now().astimezone())
    assert row.verdict is verdict
    assert "No space left" in row.found
    if removable:
        with pytest.raises(SafetyAbort, match="never been compared"):
            require()


# --- `fly` -------------------------------------------------------------------------------

LAB = """extends: sim
link: {connect_timeout_s: 0.4}
positioning: {by: mocap, system: vicon, host: lab, body: cf2}
"""


def fly(tmp_path: Path, *words: str) -> Result:
    profile = tmp_path / "lab.yaml"
    profile.write_text(LAB, encoding="utf-8")
    where = ("-u", URI, "--source", "http://127.0.0.1:1/x")
    logs = ("--log-dir", str(tmp_path / "logs"))
    done = CliRunner().invoke(app, ["fly", "-p", str(profile), *where, *logs, *words])
    assert "Traceback" not in done.output
    return done


@pytest.mark.parametrize(("record", "words"), [
    (None, "has never been compared with this vehicle"),
    ({"passed": False, "found": SWAPPED}, SWAPPED),
])  # fmt: skip
def test_fly_refuses_before_it_asks_connects_or_logs(
    record: dict[str, Any] | None, words: str, tmp_path: Path
) -> None:
    if record is not None:
        was_compared(CONFIG, URI, **record)
    done = fly(tmp_path, "--yes")
    assert done.exit_code == 52, done.output
    last = done.stderr.strip().splitlines()[-1]
    assert words in last
    assert "perchctl check --lift" in last
    assert "connecting" not in done.stderr
    assert not (tmp_path / "logs").exists()
    plan = fly(tmp_path, "--dry-run", "--json").stdout
    assert "fly refuses" in plan
    assert words in plan
    was_compared(CONFIG, URI, ago_s=3600.0)
    plan = fly(tmp_path, "--dry-run", "--json").stdout
    assert "with the hand-held vehicle on" in plan
    assert "fly refuses" not in plan
