"""`perchctl fit-weights`: files in, faults by line, weights out, and the flight that uses them."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner, Result

from perchctl.calibration.files import load_calibration
from perchctl.cli import app
from perchctl.commands import fit_weights_collect
from perchctl.commands.fit_weights_collect import _truth
from perchctl.commands.fit_weights_request import CollectRequest
from perchctl.errors import ConnectionFailed, InvalidValue, NotFound, UsageError
from perchctl.geometry import rot_z
from perchctl.positioning import capture
from perchctl.positioning.types import BodyPose, CaptureFrame
from perchctl.profile import find_calibration, load_profile
from perchctl.profile.positioning import PositioningConfig
from perchctl.weights import truth
from perchctl.weights.collect import MarkerReader, SessionFile, collecting_pipeline, fault_of
from perchctl.weights.report import figure
from perchctl.weights.table import HEADER, NEEDED, read_csv
from tests.helpers.weights_data import BEST, independent, known, write


def run(*words: object, stdin: str | None = None) -> Result:
    result = CliRunner().invoke(app, ["fit-weights", *map(str, words)], input=stdin)
    assert "Traceback" not in result.output
    return result


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return write(independent(1), tmp_path / "session.csv")


def test_one_object_with_every_method(session: Path, tmp_path: Path) -> None:
    other = write(independent(2), tmp_path / "other.csv")
    done = run(session, "--json", "--test", other)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    for name in ("lms", "closed_form", "inverse_variance"):
        assert set(found[name]) == {"x", "y", "z", "yaw"}
        assert {"x", "y", "z", "yaw"} <= set(found["errors"][name])
    assert {"large", "small", "paper"} <= set(found["errors"])
    assert found["recommended"] == found["closed_form"]
    assert found["data"]["positions"] == 10


def test_the_known_weights_come_back_through_the_file(tmp_path: Path) -> None:
    found = json.loads(run(write(known(2), tmp_path / "k.csv"), "--json").stdout)
    for axis, best in zip(("x", "y", "z", "yaw"), BEST, strict=True):
        assert found["closed_form"][axis] == pytest.approx(best, abs=0.005)
        assert found["lms"][axis] == pytest.approx(found["closed_form"][axis], abs=0.01)


def test_weights_go_to_a_file_and_from_there_into_a_flight(session: Path, tmp_path: Path) -> None:
    out, plot = tmp_path / "w.yaml", tmp_path / "w.png"
    first = run(session, "-o", out, "--plot", plot)
    assert first.exit_code == 0, first.output
    assert "Tables I and II" in first.stdout
    assert cv2.imread(str(plot)).shape[0] > 500
    written = yaml.safe_load(out.read_text())
    assert len(written["data"]["sha256"]) == 64
    refused = run(session, "-o", out, "--method", "lms")
    assert refused.exit_code == 30
    assert refused.stdout == ""
    assert "w.yaml exists already; add --force" in refused.stderr
    assert run(session, "-o", out, "--method", "lms", "--force").exit_code == 0
    assert yaml.safe_load(out.read_text()) != written
    (tmp_path / "mine.yaml").write_text(
        "extends: paper\nmerge: {method: weights, weights_file: w.yaml}\n", encoding="utf-8"
    )
    again = yaml.safe_load(out.read_text())
    profile = load_profile(str(tmp_path / "mine.yaml"))
    assert profile.merge.weights.model_dump() == pytest.approx(again["weights"])
    plan = CliRunner().invoke(app, ["fly", "-p", str(tmp_path / "mine.yaml"), "--dry-run"])
    assert again["date"] in plan.stdout
    assert again["data"]["sha256"][:12] in plan.stdout


def test_the_profile_s_own_file_is_where_they_go(session: Path, tmp_path: Path) -> None:
    profile = tmp_path / "mine.yaml"
    profile.write_text("extends: paper\nmerge: {weights_file: fitted.yaml}\n", encoding="utf-8")
    with pytest.raises(Exception, match=r"weights_file: /.*/fitted\.yaml does not exist"):
        load_profile(str(profile))
    assert run(session, "-p", profile).exit_code == 0
    written = (tmp_path / "fitted.yaml").read_text()
    again = run(session, "-p", profile, "--method", "lms")
    assert again.exit_code == 0
    assert "recommended" in again.stdout
    assert "fitted.yaml exists already and stays as it is; add --force" in again.stderr
    assert (tmp_path / "fitted.yaml").read_text() == written
    (tmp_path / "heir.yaml").write_text(f"extends: {profile}\n", encoding="utf-8")
    for name in ("mine.yaml", "heir.yaml"):
        assert load_profile(str(tmp_path / name)).merge.weights.x == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("weights: {x: 2, y: 0, z: 0, yaw: 0}", "weights.x"),
        ("weights: {x: 0.5, y: 0, z: 0}", "weights.yaw is missing"),
        ("date: today", "weights"),
        ("- 1", "keys and values"),
    ],
)
def test_a_bad_weights_file_is_one_sentence(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "w.yaml").write_text(text, encoding="utf-8")
    (tmp_path / "p.yaml").write_text("merge: {weights_file: w.yaml}\n", encoding="utf-8")
    with pytest.raises(InvalidValue, match=r"w\.yaml") as raised:
        load_profile(str(tmp_path / "p.yaml"))
    assert said in str(raised.value)


def test_weights_that_do_not_help_are_not_written(tmp_path: Path) -> None:
    data = write(independent(3, small=(0.5, 0.5, 0.5, 0.5)), tmp_path / "s.csv")
    refused = run(data, "-o", tmp_path / "w.yaml")
    assert refused.exit_code == 1
    assert "not written" in refused.stderr
    assert not (tmp_path / "w.yaml").exists()
    assert run(data, "-o", tmp_path / "w.yaml", "--anyway").exit_code == 0
    assert json.loads(run(data, "--json").stdout)["recommended"] is None
    told = run(data, "-o", tmp_path / "v.yaml", "--json")
    assert told.exit_code == json.loads(told.stdout)["exit_code"] == 1
    assert "not written" in json.loads(told.stdout)["error"]


# -- the report --------------------------------------------------------------


def test_the_report_fits_a_terminal_with_the_verdict_first_and_notes_last(tmp_path: Path) -> None:
    """80 columns, also of data that are off by half a metre; micrometres, no exponents."""
    for name, data in (("good", known(1)), ("wild", independent(3, small=(0.5,) * 4, positions=4))):
        path = write(data, tmp_path / f"{name}.csv")
        other = write(independent(8), tmp_path / "other.csv")
        text = run(path, "--test", other).stdout
        lines = text.splitlines()
        assert max(len(line) for line in lines if str(tmp_path) not in line) <= 80
        assert "[um]" in text
        assert "[mm]" not in text
        assert not re.search(r"\de[+-]\d|(?<!\+)-0\.00\b", text)
        paragraphs = text.split("\n\n")
        assert "recommended" in paragraphs[1]
        notes = [k for k, part in enumerate(paragraphs) if part.startswith("note:")]
        assert notes in ([], [len(paragraphs) - 1])
    assert paragraphs[1].startswith("not recommended")
    assert notes  # of few positions


@pytest.mark.parametrize(
    ("value", "text"),
    [(-0.0643, "-0.06"), (-0.001, "0.00"), (8.126, "8.13"), (99.96, "100"), (5.16e5, "516k")],
)
def test_figures_have_three_digits_and_no_exponent(value: float, text: str) -> None:
    assert figure(value) == text


def test_what_is_not_written_is_said(session: Path, tmp_path: Path) -> None:
    assert "no file written: name one with -o" in run(session).stderr
    bad = write(independent(3, small=(0.5,) * 4), tmp_path / "s.csv")
    assert "no file written: the weights are not recommended" in run(bad).stderr
    out, plot = tmp_path / "w.yaml", tmp_path / "w.png"
    found = json.loads(run(session, "--json", "-o", out, "--plot", plot).stdout)
    assert (found["weights_file"], found["plot"]) == (str(out), str(plot))
    found = json.loads(run(session, "--json").stdout)
    assert (found["weights_file"], found["plot"]) == (None, None)


@pytest.mark.parametrize("as_json", [False, True])
def test_ctrl_c_in_the_drawing_leaves_the_result(
    as_json: bool, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(_result: object) -> bytes:
        raise KeyboardInterrupt

    monkeypatch.setattr("perchctl.weights.plot.draw_weights", draw)
    done = run(session, "--plot", tmp_path / "w.png", *(["--json"] if as_json else []))
    assert done.exit_code == 130
    if as_json:
        found = json.loads(done.stdout)
        assert (found["plot"], found["exit_code"]) == (None, 130)
        assert found["recommended"]
    else:
        assert "recommended weights" in done.stdout


# -- the same rows twice -------------------------------------------------------


def test_the_same_rows_twice_are_refused(session: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.csv"
    text = session.read_text()
    header, rows = text.split("\n", 1)
    for arguments, content, said in (
        ((session, session), text, "named twice"),
        ((session, copy), text, "hold the same data"),
        ((session, copy), text.rsplit("\n", 2)[0] + "\n", "line 2: this row stands in line 2 of"),
        ((copy,), f"{header}\n{rows}{rows}", "line 1002: this row stands in line 2 of"),
        ((session, "--test", copy), text, "--test judges by other data"),
        ((session, "--test", copy), f"{header}\n{rows[rows.index(chr(10)) + 1 :]}", "--test"),
    ):
        copy.write_text(content)
        done = run(*arguments)
        assert done.exit_code == 30, said
        assert said in done.stderr
        assert done.stderr.count("\n") == 1
        assert not done.stdout


def test_rows_without_times_may_be_equal(tmp_path: Path) -> None:
    """Rounded measurements of a camera at rest: no evidence twice, as far as one can say."""
    data = independent(4, per=20)
    rounded = [np.round(pose, 3) for pose in (data.large, data.small, data.actual)]
    for t_s, code in ((data.t_s * 0.0, 0), (np.repeat(data.t_s[::2], 2), 30)):
        large, small, actual = (np.repeat(pose[::2], 2, axis=0) for pose in rounded)
        twice = replace(data, t_s=t_s, large=large, small=small, actual=actual)
        assert run(write(twice, tmp_path / "r.csv")).exit_code == code


# -- bad input ---------------------------------------------------------------

Edit = Callable[[list[list[str]]], None]


def _scaled(source: str, factor: float, positions: tuple[str, ...] | None = None) -> Edit:
    def edit(rows: list[list[str]]) -> None:
        columns = [k for k, name in enumerate(rows[0]) if name[:5] == source and name[-2:] == "_m"]
        for row in rows[1:]:
            for k in columns:
                if positions is None or row[0] in positions:
                    row[k] = str(float(row[k]) * factor)

    return edit


def _cell(line: int, column: str, text: str) -> Edit:
    def edit(rows: list[list[str]]) -> None:
        rows[line - 1][NEEDED.index(column)] = text

    return edit


def _column(column: str, text: Callable[[list[str]], str]) -> Edit:
    def edit(rows: list[list[str]]) -> None:
        for row in rows[1:]:
            row[NEEDED.index(column)] = text(row)

    return edit


def _all(*edits: Edit) -> Edit:
    def edit(rows: list[list[str]]) -> None:
        for each in edits:
            each(rows)

    return edit


def _unseen(marker: str) -> Edit:
    return _all(*(_column(name, lambda row: "") for name in NEEDED if name.startswith(marker)))


def _missing(rows: list[list[str]]) -> None:
    rows[0][NEEDED.index("small_z_m")] = "other"


def _shorter(rows: list[list[str]]) -> None:
    rows[5].pop()


BAD: dict[str, tuple[Edit, str]] = {
    "missing column": (_missing, "line 1: column small_z_m is missing"),
    "centimetres": (_scaled("actua", 100.0), "line 2: actual_x_m looks like centimetres"),
    "one position in centimetres": (_scaled("actua", 100, ("7",)), "line 122: actual_"),
    "millimetres": (_scaled("small", 1000.0), "line 2: small_x_m looks like millimetres"),
    "all in centimetres": (
        _all(*(_scaled(s, 100.0) for s in ("large", "small", "actua"))),
        "line 2: all positions look like centimetres",
    ),
    "degrees": (
        _column("actual_yaw_rad", lambda r: str(math.degrees(float(r[13])))),
        "like degrees",
    ),
    "one position": (_column("position", lambda r: "1"), "line 2: all rows with both"),
    "never seen": (_unseen("small"), "lines 2 to 201: the small marker is never seen"),
    "nan": (_cell(100, "large_x_m", "NaN"), "line 100: large_x_m: NaN is not a measurement"),
    "infinite": (_cell(9, "large_x_m", "1e999"), "line 9: large_x_m: the number is beyond"),
    "a word": (_cell(100, "large_x_m", "abc"), "line 100: large_x_m: 'abc' is not a number"),
    "half a pose": (_cell(50, "small_y_m", ""), "line 50: small_y_m: the cell is empty"),
    "no truth": (_cell(51, "actual_z_m", ""), "line 51: actual_z_m: the cell is empty"),
    "constant": (_column("large_z_m", lambda r: "0.2"), "line 2: large_z_m is 0.2 in every row"),
    "a copied column": (_column("large_z_m", lambda r: r[8]), "same z in every row"),
    "a short line": (_shorter, "line 6: 13 cells where the header has 14"),
    "position": (_cell(8, "position", "1.5"), "line 8: position: must be a whole number"),
}


@pytest.mark.parametrize("name", sorted(BAD))
def test_bad_input_is_one_sentence_with_file_and_line(name: str, tmp_path: Path) -> None:
    edit, said = BAD[name]
    path = write(independent(5, per=20), tmp_path / "bad.csv")
    rows = [line.split(",") for line in path.read_text().splitlines()]
    edit(rows)
    path.write_text("".join(",".join(row) + "\n" for row in rows), encoding="utf-8")
    done = run(path)
    assert done.exit_code == 30
    assert done.stderr.count("\n") == 1
    assert f"{path}: line" in done.stderr
    assert said in done.stderr


def test_a_file_cut_in_a_line_is_named_with_the_line(tmp_path: Path) -> None:
    path = write(independent(5, per=20), tmp_path / "bad.csv")
    path.write_bytes(path.read_bytes()[:10_000])
    lines = path.read_text().count("\n")
    done = run(path)
    assert done.exit_code == 30
    assert f"line {lines + 1}: the file is cut in the middle of this line" in done.stderr


def test_other_columns_orders_blanks_and_quotes_are_read(tmp_path: Path) -> None:
    plain = write(known(4, per=20), tmp_path / "a.csv")
    rows = [line.split(",") for line in plain.read_text().splitlines()]
    odd = "\ufeff" + "\r\n".join(
        ",".join(['"' + row[0] + '"', "note", *(f" {c}" for c in row[:0:-1])]) for row in rows
    )
    (tmp_path / "b.csv").write_text(
        odd.replace("\r\n", "\r\n\r\n", 1), encoding="utf-8", newline=""
    )
    one, two = (read_csv(tmp_path / name) for name in ("a.csv", "b.csv"))
    assert np.array_equal(one.large, two.large)
    assert np.array_equal(one.actual, two.actual)
    assert two.line[0] == 3
    assert "last line has no end" in two.notes[0]


# -- collecting ----------------------------------------------------------------


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of four simulated positions; the last one was stopped in a line."""
    path = tmp_path_factory.mktemp("sim") / "session.csv"
    pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
    options = ("--collect", path, "--truth", "sim", "--frames", 12, "--positions", 4)
    done = run(*options, "--json")
    assert done.exit_code == 0, done.output
    return path


def test_the_simulated_experiment_is_continued_where_it_stopped(simulated: Path) -> None:
    whole = simulated.read_bytes()
    data = read_csv(simulated)
    assert np.unique(data.position).tolist() == [1, 2, 3, 4]
    assert len(data) == 48
    assert data.joint is not None
    for pose in (data.large, data.small, data.joint):
        assert np.abs((pose - data.actual)[:, :3]).max() < 2e-3
    torn = simulated.with_name("torn.csv")
    torn.write_bytes(whole[: len(whole) - 700])  # within position 4
    done = run("--collect", torn, "--truth", "sim", "--frames", 12, "--positions", 4)
    assert done.exit_code == 0, done.output
    assert "an unfinished end was taken off" in done.stderr
    assert torn.read_bytes() == whole


def test_a_file_that_is_no_session_is_left_alone(session: Path) -> None:
    before = session.read_bytes()
    done = run("--collect", session, "--truth", "sim")
    assert done.exit_code == 30
    assert "nothing is appended" in done.stderr
    assert session.read_bytes() == before


def test_shaken_and_half_seen_positions_are_refused() -> None:
    from perchctl.weights.simulated import Stand

    profile = load_profile("sim")
    camera = load_calibration(find_calibration(profile.camera.calibration))
    stand = Stand(profile, camera, 2, 0, 4.0, 1.0)
    place = stand.place(1)
    reader = MarkerReader(collecting_pipeline(profile, camera))
    good = [reader.read(frame) for frame in stand.frames(1, place, 6)]
    assert fault_of(good) is None
    moved = place.T_world_cam.copy()
    moved[0, 3] += 0.002
    other = type(place)(moved, place.actual)
    late = [reader.read(frame) for frame in stand.frames(1, other, 6)]
    assert "shaken" in (fault_of([*good, *late]) or "")
    blind = [type(s)(s.t_s, s.large, None, None, None) for s in good]
    assert "the small marker was found in 6 of 12" in (fault_of([*good, *blind]) or "")
    assert "only 2 frames" in (fault_of(good[:2]) or "")


def test_the_dialogue_asks_refuses_and_goes_on(tmp_path: Path) -> None:
    """Pictures of two places; the person mistypes, doubts, stops, and goes on."""
    from perchctl.weights.simulated import Stand

    profile = load_profile("sim")
    camera = load_calibration(find_calibration(profile.camera.calibration))
    stand = Stand(profile, camera, 2, 0, 4.0, 1.0)
    pictures, typed = tmp_path / "pictures", []
    pictures.mkdir()
    for position, name in ((1, "a"), (1, "b"), (2, "c")):
        place = stand.place(position)
        x, y, z = place.actual[:3] * 100
        typed.append(f"{x:.2f} {y:.2f} {z:.2f} {math.degrees(place.actual[3]):.1f}")
        for k, frame in enumerate(stand.frames(position, place, 10)):
            cv2.imwrite(str(pictures / f"{name}{k:02d}.png"), frame.image)
    path = tmp_path / "session.csv"
    # No pose; a wrong one, taken back; a right one; enough for today.
    answers = ["12 x", "0 0 60 0", "", "n", typed[1], "", "q"]
    words = ("--collect", path, "--frames", 10, "--positions", 2, "--source", f"images:{pictures}")
    done = run(*words, stdin="\n".join(answers) + "\n")
    assert done.exit_code == 130, done.output
    assert "is not a pose: four numbers are needed" in done.stderr
    assert "does not fit what the camera sees" in done.stderr
    assert "stopped with 1 positions" in done.stderr
    assert len(read_csv(path)) == 10
    for old in pictures.glob("[ab]*"):
        old.unlink()
    done = run(*words, stdin=f"{typed[2]}\n\n")
    assert done.exit_code == 0, done.output
    assert "holds 1 positions already" in done.stderr
    assert np.unique(read_csv(path).position).tolist() == [1, 2]


def test_the_estimate_s_truth_is_learned_by_touching() -> None:
    gear = np.array([0.0, 0.0, 0.03])
    target = np.array([0.4, -0.3, 2.0])
    poses = [((*(target - gear),), 0.5), ((0.35, -0.25, 1.8), 0.7)]
    asked: list[str] = []

    def telemetry() -> list[SimpleNamespace]:
        position, yaw = poses[min(len(asked) // 2, 1)]
        return [SimpleNamespace(position_m=position, roll_rad=0.0, pitch_rad=0.0, yaw_rad=yaw)] * 9

    source = truth.EstimateTruth(telemetry, None, gear, wait=lambda s: None)  # type: ignore[arg-type]

    def ask(question: str) -> str:
        asked.append(question)
        return ""

    found = source.actual(ask)
    expected = rot_z(-0.7) @ (target - [0.35, -0.25, 1.8]) - gear
    assert found.pose[:3] == pytest.approx(expected)
    assert found.pose[3] == pytest.approx(-0.2)
    assert truth.moved(found, source.actual(ask)) is None


class Recorded:
    """A capture of three bodies with some noise, 100 frames a second of a clock of its own."""

    def __init__(self, noise_m: float = 1e-4) -> None:
        self.now_s, self.noise_m, self.trouble = 0.0, noise_m, ""

    def clock(self) -> float:
        return self.now_s

    def wait(self, duration_s: float) -> None:
        self.now_s += duration_s

    def frames(self) -> list[CaptureFrame]:
        self.now_s += 0.01
        noise_m = self.noise_m * math.sin(1e4 * self.now_s)
        turned = (math.cos(0.2), 0.0, 0.0, math.sin(0.2))
        bodies = {
            "cf": BodyPose((0.1 + noise_m, 0.2, 1.0), (1.0, 0.0, 0.0, 0.0)),
            "askew": BodyPose((0.1 + noise_m, 0.2, 1.0), turned),
            "target": BodyPose((0.1, 0.25 + noise_m, 1.2), turned),
        }
        return [CaptureFrame(self.now_s, bodies)]

    def problem(self, now_s: float) -> str | None:
        return self.trouble or None

    def close(self) -> None:
        return None


def test_motion_capture_gives_the_median_or_names_the_bodies() -> None:
    gear = np.array([0.0, 0.0, 0.03])

    def truth_of(
        capture: Recorded, body: str, mounted: PositioningConfig | None = None
    ) -> truth.MocapTruth:
        return truth.MocapTruth(
            capture, "vicon:host", body, "target", gear, mounted, capture.clock, capture.wait
        )

    found = truth_of(Recorded(), "cf").actual(lambda question: "")
    assert found.pose == pytest.approx([0.0, 0.05, 0.17, 0.4], abs=2e-4)
    mounted = PositioningConfig(by="mocap", body_rpy_deg=(0.0, 0.0, math.degrees(0.4)))
    found = truth_of(Recorded(), "askew", mounted).actual(lambda question: "")
    assert found.pose == pytest.approx([0.0, 0.05, 0.17, 0.4], abs=2e-4)
    with pytest.raises(NotFound, match="rigid body 'drone'; it sees askew, cf, target"):
        truth_of(Recorded(), "drone").actual(lambda question: "")
    with pytest.raises(NotFound, match="'cf' frozen"):
        truth_of(Recorded(noise_m=0.0), "cf").actual(lambda question: "")
    gone = Recorded()
    gone.trouble = "motion capture at vicon:host has ended"
    with pytest.raises(ConnectionFailed, match="has ended"):
        truth_of(gone, "drone").actual(lambda question: "")


def test_motion_capture_is_asked_for_with_its_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    for mocap in (None, "vicon", "vicon: "):
        with pytest.raises(UsageError, match="--mocap TYPE:HOST"):
            _truth(CollectRequest(truth="mocap", mocap=mocap), load_profile("sim"), lambda: 0.0)
    monkeypatch.setattr(capture, "find_spec", lambda name: object())
    with pytest.raises(InvalidValue, match="'nokov' is unknown; allowed are vicon, optitrack"):
        _truth(CollectRequest(truth="mocap", mocap="nokov:h"), load_profile("sim"), lambda: 0.0)
    monkeypatch.setattr(capture, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match="--truth mocap needs the library motioncapture"):
        _truth(CollectRequest(truth="mocap", mocap="vicon:h"), load_profile("sim"), lambda: 0.0)


def test_motion_capture_is_the_profile_s_where_no_option_names_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[str, str]] = []

    def opened(system: str, body: str, needed_by: str) -> Recorded:
        asked.append((system, body))
        return Recorded()

    monkeypatch.setattr(fit_weights_collect, "open_named", opened)
    own = PositioningConfig(by="mocap", system="qualisys", host="lab:22223", body="cf2")
    plain = load_profile("sim")
    lab = plain.model_copy(update={"positioning": own})
    for request, profile, expected in (
        (CollectRequest(), lab, ("qualisys:lab:22223", "cf2")),
        (CollectRequest(mocap="vicon:h"), lab, ("vicon:h", "cf2")),
        (CollectRequest(bodies="cf7,board"), lab, ("qualisys:lab:22223", "cf7")),
        (CollectRequest(mocap="vicon:h"), plain, ("vicon:h", "cf")),
    ):
        _truth(replace(request, truth="mocap"), profile, lambda: 0.0)
        assert asked[-1] == expected


def test_a_session_of_another_header_and_the_shipped_header_agree(tmp_path: Path) -> None:
    file = SessionFile(tmp_path / "new.csv", 10)
    assert file.path.read_text() == HEADER + "\n"
    assert HEADER.startswith(",".join(NEEDED))
    assert file.next_position == 1


def test_the_readers_of_nothing_are_told(tmp_path: Path) -> None:
    done = run()
    assert done.exit_code == 2
    assert "--collect" in done.stderr
    assert run(tmp_path / "none.csv").exit_code == 20
    assert run("x.csv", "--method", "magic").exit_code == 30
