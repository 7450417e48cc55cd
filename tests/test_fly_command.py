"""`perchctl fly`: its plan, one sentence and an exit code for each bad input and peer, and what
follows the flight."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.calibration import load_calibration
from perchctl.commands import app
from perchctl.commands.fly import fly_and_report, resolve_options
from perchctl.errors import EXIT_CODES, Interrupted
from perchctl.mission import FlightReport, Outcome, Phase
from perchctl.record import LogWatcher
from perchctl.sim import SimProcess
from tests.helpers.commands import elsewhere, run, run_apart  # noqa: F401
from tests.helpers.flights import ROOT, SHORT

NOWHERE = "udp://127.0.0.1:9"
RADIO = "radio://0/80/2M/E7E7E7E7E7"
GOLDEN = Path(__file__).parent / "data" / "fly_dry_run.txt"


@pytest.fixture
def profile(tmp_path: Path) -> str:
    """The short profile, impatient with peers that do not answer."""
    path = tmp_path / "mine.yaml"
    path.write_text(f"extends: {SHORT}\nlink: {{connect_timeout_s: 1.0}}\n")
    return str(path)


# --- The plan ------------------------------------------------------------------------------


def test_dry_run_tells_the_plan_and_connects_nothing(tmp_path: Path) -> None:
    said = run("fly", "-p", SHORT, "--seed", "7", "--dry-run")
    assert (said.code, said.stderr) == (0, "")
    # A path may be of any length: where it wraps the lines is no part of the plan.
    plan = " ".join(said.stdout.replace(str(ROOT), "ROOT").split())
    assert plan == " ".join(GOLDEN.read_text(encoding="utf-8").split())
    assert max(map(len, said.stdout.replace(str(ROOT), "").splitlines())) <= 80
    real = run("fly", "-p", SHORT, "-u", "usb://0", "--source", "camera:0", "--dry-run")
    assert "\nwarn         calibration file: example_640x480.yaml" in real.stdout
    assert list(tmp_path.iterdir()) == []  # no log either


@pytest.mark.parametrize(("words", "keys", "code", "named"), [
    ("", "camera: {mount: {rpy_deg: [90, 0, 0]}}", 52, "camera turn"),
    ("--log-dir afile", "{}", 30, "afile"),
    ("-u usb://0 --source camera:0", "positioning: {by: mocap, host: lab, body: cf}", 52, "never"),
])  # fmt: skip
def test_a_plan_that_fly_refuses_exits_as_fly_does(
    words: str, keys: str, code: int, named: str
) -> None:
    """Otherwise a script that flies what the plan allows finds out in the air's reach."""
    pytest.importorskip("motioncapture" if "mocap" in keys else "mujoco")
    Path("bad.yaml").write_text(f"extends: sim\n{keys if keys != '{}' else ''}\n")
    Path("afile").touch()
    planned = run("fly", "-p", "bad.yaml", *words.split(), "--dry-run")
    assert (planned.code, run("fly", "-p", "bad.yaml", *words.split(), "--yes").code) == (
        code,
        code,
    )
    assert named in planned.stderr
    assert "log " in planned.stdout  # the plan is shown all the same
    record = json.loads(run("fly", "-p", "bad.yaml", *words.split(), "--dry-run", "--json").stdout)
    assert record["exit_code"] == code
    assert named in record["error"]


def test_the_plan_loads_what_the_profile_names(tmp_path: Path) -> None:
    (tmp_path / "my_part.py").write_text("class Camera: pass\n")
    said = run("fly", "--source", "my_part:Camra", "--dry-run")
    assert (said.code, "did you mean Camera?" in said.stderr) == (20, True)
    assert run("fly", "--source", "my_part:Camera", "--dry-run").code == 0


SCHEMES = ("camera", "video", "images", "sim", "http", "rtsp", "aideck", "radio", "usb", "udp")


@pytest.mark.parametrize("words", [
    "fly --dry-run --source camera:HDMI", "fly --dry-run --source CAMERA:HDMI",
    "fly --dry-run --source video:flight", "fly --dry-run --source images:pictures",
    "fly --dry-run --source sim:here", "fly --dry-run --source aideck:deck",
    "fly --dry-run -u radio:mine --source camera:0", "fly --dry-run -u usb:mine",
    "fly --dry-run -u sim:here", "fly --dry-run -u udp:host -p crazyflie",
    "check --source camera:HDMI -u udp://127.0.0.1:9", "check -u radio:mine",
    "track camera:HDMI", "track sim:here", "calibrate camera:HDMI -o x.yaml",
    "profile new --defaults --set camera.source=camera:HDMI",
    "profile new --defaults --set link.uri=radio:mine",
    "profile new --defaults --set positioning.system=vicon:lab",
    "fly --dry-run -p mocap.yaml",
])  # fmt: skip
def test_a_scheme_is_never_taken_for_a_module_that_lies_about(words: str) -> None:
    """What is here would run: a scheme comes first, everywhere."""
    for name in (*SCHEMES, "vicon", "CAMERA"):
        Path(f"{name}.py").write_text("open('ran', 'w').close()\nHDMI = mine = here = lab = None\n")
    Path("mocap.yaml").write_text("extends: sim\npositioning: {by: mocap, system: 'vicon:lab'}\n")
    said = run(*words.split())
    assert not Path("ran").exists(), said
    if "vicon:lab" in words or "mocap" in words:
        assert "'vicon:lab' is vicon with a host" in said.stderr


def test_the_uri_of_the_environment_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CFLIB_URI", "bogus")
    assert run("fly", "--dry-run").code == 30
    assert "udp://h:1" in run("fly", "--dry-run", "-u", "udp://h:1", "--source", "camera:0").stdout


def test_the_plan_warns_about_the_uri_that_is_flown(profile: str) -> None:
    words = f"fly -p {profile} --source camera:0 --dry-run --json -u radio://0/80/2M/"
    for address, warns in (("E7", True), ("E7E7E7E7E7", False)):
        names = [
            row["name"] for row in json.loads(run(*f"{words}{address}".split()).stdout)["check"]
        ]
        assert ("short address" in names) is warns


# --- Bad input, before anything is opened ---------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code", "named"),
    [
        ("-p smi", 20, ["'smi'", "sim"]),
        ("-p misspelt.yaml", 30, ["misspelt.yaml", "kalman.alfa", "unknown", "alpha"]),
        ("-p ./none.yaml", 20, ["none.yaml", "does not exist"]),
        ("--uri bogus", 30, ["'bogus'", "radio://0/80/2M"]),
        ("--uri udp://127.0.0.1:99999 --yes", 30, ["65535"]),
        (f"--uri {NOWHERE}", 2, ["sim:", "--source"]),
        (f"--uri {NOWHERE} --source sim: --yes", 2, ["sim:", "--source"]),
        ("--source webcam:0", 30, ["'webcam:0'", "camera:N"]),
        ("--source=", 30, ["camera:N"]),
        ("--dry-run --source webcam:0", 30, ["'webcam:0'", "camera:N"]),
        ("--seed -1", 30, ["'-1'", "whole numbers of 0 or more"]),
        (f"--uri {NOWHERE} --source camera:97 --yes", 20, ["camera:97"]),
        ("--source video:none.mp4", 20, ["none.mp4"]),
        (f"--uri {NOWHERE} --source video:none.mp4", 2, ["recording", NOWHERE]),
        ("-p crazyflie --source video:none.mp4 --dry-run", 2, ["recording", "--source"]),
    ],
)
def test_bad_input(words: str, code: int, named: list[str]) -> None:
    Path("misspelt.yaml").write_text("extends: sim\nkalman: {alfa: 0.85}\n")
    said = run("fly", *words.split())
    assert said.code == code, said
    for word in named:
        assert word in said.complaint


@pytest.mark.parametrize(
    ("command", "folder"),
    [
        ("simulate", "afile"),
        pytest.param("simulate", "/proc/none", marks=pytest.mark.long),
        pytest.param("fly", "afile", marks=pytest.mark.long),
        ("fly", "/proc/none"),
    ],
)
def test_a_log_that_cannot_be_written(command: str, folder: str) -> None:
    Path("afile").touch()
    said = run(*command.split(), "--log-dir", folder)
    assert said.code == 30
    assert folder in said.complaint


# --- Consent ---------------------------------------------------------------------------------


def test_nobody_to_ask_is_no_consent() -> None:
    said = run_apart("fly", "--uri", NOWHERE, "--source", "camera:97")
    assert said.code == 2
    assert "--yes" in said.complaint
    assert NOWHERE in said.complaint


@pytest.fixture(scope="module")
def simulated() -> Iterator[SimProcess]:
    """A vehicle with a camera, which none of these tests flies."""
    with SimProcess.start(camera=load_calibration("example_640x480.yaml")) as sim:
        yield sim


@pytest.fixture
def eyes(simulated: SimProcess) -> str:
    """A camera that lives, as a source."""
    return simulated.stream_url


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", type("Terminal", (), {"isatty": lambda self: True})())


@pytest.mark.usefixtures("terminal")
def test_nobody_is_asked_before_the_camera_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("builtins.input", pytest.fail)
    with pytest.raises(SystemExit) as left:
        app(["fly", "--uri", NOWHERE, "--source", "camera:97"])
    assert left.value.code == 20


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize(("answer", "flies"), [("n", False), ("", False), ("y", True)])
def test_only_a_yes_is_consent(
    answer: str,
    flies: bool,
    simulated: SimProcess,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def flown(*_: object) -> None:
        raise Interrupted("it would fly")

    monkeypatch.setattr("builtins.input", lambda: answer)
    monkeypatch.setattr("perchctl.flight.session.fly", flown)
    with pytest.raises(SystemExit) as left:
        app(["fly", "--uri", simulated.uri, "--source", simulated.stream_url])
    assert left.value.code == (130 if flies else 2)
    said = capsys.readouterr()
    assert "Is the space under the target clear?" in said.err
    assert ("not confirmed" in said.err) is not flies
    assert ("it would fly" in said.err) is flies
    assert said.out == ""


# --- Bad peers ------------------------------------------------------------------------------


@pytest.mark.long
def test_a_silent_peer(profile: str, eyes: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute:
        mute.bind(("127.0.0.1", 0))
        uri = f"udp://127.0.0.1:{mute.getsockname()[1]}"
        said = run("fly", "-p", profile, "--uri", uri, "--source", eyes, "--yes")
    assert said.code == 10
    assert uri in said.complaint
    assert "no answer within" in said.complaint


def test_a_radio_that_is_not_there(profile: str, eyes: str) -> None:
    said = run("fly", "-p", profile, "--uri", RADIO, "--source", eyes, "--yes")
    assert said.code == 10
    for words in (RADIO, "no Crazyradio is plugged in", "udev"):
        assert words in said.stderr


@pytest.mark.long
def test_the_library_s_tracebacks_stay_away(profile: str, eyes: str) -> None:
    """cflib logs them unless it is told not to: seen by a process of its own."""
    said = run_apart("fly", "-p", profile, "--uri", NOWHERE, "--source", eyes, "--yes")
    assert said.code == 10
    assert "no program is listening there" in said.stderr
    assert "link error callback" not in said.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    ("link", "code", "words"),
    [
        (
            {"missing_log_variables": ("stateEstimate.vz",)},
            20,
            ["stateEstimate.vz", "update the firmware"],
        ),
        ({"protocol_version": 11}, 10, ["protocol 11", "12", "update the firmware"]),
    ],
    ids=["a log variable is missing", "old protocol"],
)
def test_an_unfit_firmware(link: dict[str, Any], code: int, words: list[str], eyes: str) -> None:
    with SimProcess.start(link=link) as sim:
        said = run("fly", "-p", SHORT, "--uri", sim.uri, "--source", eyes, "--yes")
        assert max(sim.truth()["motors"]) == 0
    assert said.code == code
    for word in words:
        assert word in said.complaint


@pytest.mark.long
def test_a_calibration_of_another_size(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).normal(120, 6, (240, 320)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "p.png"), noise)
    said = run("fly", "-p", SHORT, "--source", f"images:{tmp_path}")
    assert said.code == 30
    for word in ("320x240", "640x480", "calibrat"):
        assert word in said.complaint


# --- After the flight --------------------------------------------------------------------------


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight that has ended, as `fly` gets it, and a plot that is drawn in no time."""
    landed = FlightReport(Phase.LANDED, Outcome.ENDED_BY_OPERATOR, "Ctrl-C", 0, 3.0, False)
    monkeypatch.setattr("perchctl.flight.fly_session", lambda *_, **__: (landed, None))
    monkeypatch.setattr("perchctl.analysis.plot_flight", lambda *_: None)


@pytest.mark.usefixtures("flown")
def test_the_outcome_and_the_plot_are_told_on_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    assert fly_and_report(resolve_options(), as_json=False, view=False) == 130
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert lines[0].startswith("LANDED: Ctrl-C")
    (log,) = Path("perchctl-logs").glob("*.jsonl")
    assert lines[-2:] == [f"log:       {log}", f"plot:      {log.with_suffix('.png')}"]
    assert err == "perchctl: connecting to sim://\n"
    fly_and_report(resolve_options(), as_json=True, view=False)
    out, err = capsys.readouterr()  # the object is alone on stdout
    told = json.loads(out)
    assert told["plot"] == told["log"].replace(".jsonl", ".png")
    assert "LANDED: Ctrl-C" in err


@pytest.mark.usefixtures("flown")
@pytest.mark.parametrize("name", ["plot_flight", "__getattr__"])
def test_ctrl_c_in_the_drawing_or_its_loading_leaves_the_result(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has been told before the drawing begins, and the object follows without a plot."""

    def draw(*_arguments: object) -> None:
        assert "LANDED: Ctrl-C" in capsys.readouterr().err
        os.kill(os.getpid(), 2)  # Ctrl-C

    monkeypatch.delattr("perchctl.analysis.plot_flight")
    monkeypatch.setattr(f"perchctl.analysis.{name}", draw, raising=False)
    code = fly_and_report(resolve_options(), True, False)
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert (code, told["exit_code"], told["outcome"], told["plot"]) == (130, 130, "landed", None)
    assert told["error"] == f"{EXIT_CODES[130]}: Ctrl-C"
    assert "the plot could not be drawn" in err


@pytest.mark.usefixtures("flown")
def test_ctrl_c_behind_the_landing_does_not_replace_the_result(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pressed while the log is closed, which may take seconds on a slow disk."""
    close = LogWatcher.close

    def slow(self: LogWatcher, *arguments: Any) -> Any:
        os.kill(os.getpid(), 2)
        return close(self, *arguments)

    monkeypatch.setattr(LogWatcher, "close", slow)
    assert fly_and_report(resolve_options(), True, False) == 130
    assert json.loads(capsys.readouterr().out)["outcome"] == "landed"
