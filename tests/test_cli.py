"""The command line: its help, its exit codes, and one sentence for each bad input."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl import __version__
from perchctl.calibration.files import load_calibration
from perchctl.cli import app
from perchctl.cli.app import reported
from perchctl.errors import EXIT_CODES, InvalidValue, ProfileNote
from perchctl.flight.session import PLAIN_SEED
from perchctl.log.read import read_log
from perchctl.sim.crtp.server import LinkOptions
from perchctl.sim.process.handle import SimProcess
from tests.helpers.flights import ROOT, SEED, SHORT
from tests.helpers.recording import write_pictures
from tests.helpers.weights_data import known
from tests.helpers.weights_data import write as write_session

HEAVY = ("cv2", "numpy", "cflib", "matplotlib", "mujoco", "pydantic", "filterpy", "scipy")
NOWHERE = "udp://127.0.0.1:9"
ESCAPE = "\x1b"


@dataclass(frozen=True)
class Said:
    code: int
    stdout: str
    stderr: str

    @property
    def complaint(self) -> str:
        """The one sentence on stderr."""
        lines = [s for s in self.stderr.splitlines() if not s.startswith("perchctl: connecting")]
        assert len(lines) == 1, self.stderr
        assert lines[0].startswith("perchctl: ")
        return lines[0].removeprefix("perchctl: ")


def run(*arguments: str) -> Said:
    """The application in this process."""
    result = CliRunner().invoke(app, arguments)
    assert "Traceback" not in result.output
    return Said(result.exit_code, result.stdout, result.stderr)


def run_apart(*arguments: str, **environment: str) -> Said:
    """The application in a process of its own, on pipes, without a terminal."""
    clean = {k: v for k, v in os.environ.items() if k not in ("CFLIB_URI", "NO_COLOR")}
    done = subprocess.run(
        [sys.executable, "-m", "perchctl", *arguments],
        env=clean | {"PYTHONPATH": str(ROOT)} | environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert "Traceback" not in done.stderr
    return Said(done.returncode, done.stdout, done.stderr)


@pytest.fixture(autouse=True)
def _elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Logs and the table cache stay out of the user's folders."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CFLIB_URI", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture
def profile(tmp_path: Path) -> str:
    """The short profile, impatient with peers that do not answer."""
    path = tmp_path / "mine.yaml"
    path.write_text(f"extends: {SHORT}\nlink: {{connect_timeout_s: 1.0}}\n")
    return str(path)


def pictures(folder: Path, size_px: tuple[int, int] = (640, 480), count: int = 200) -> str:
    """A folder of pictures that show nothing, as a source; `count` copies of one."""
    folder.mkdir()
    noise = np.random.default_rng(0).normal(120, 6, size_px[::-1]).astype(np.uint8)
    cv2.imwrite(str(folder / "p0.png"), noise, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    for i in range(1, count):
        os.link(folder / "p0.png", folder / f"p{i}.png")
    return f"images:{folder}"


# --- Help --------------------------------------------------------------------------------


def test_help_loads_nothing_heavy() -> None:
    """It answers in under 0.3 s because of what it does not import."""
    code = (
        "import sys\nsys.argv = ['perchctl', '--help']\n"
        "from perchctl.cli import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert "simulate" in done.stdout
    assert done.stderr.strip() == "[]"


def test_the_help_lists_the_commands_in_the_order_of_use() -> None:
    commands = ["make-target", "calibrate", "fit-weights", "track", "fly", "simulate"]
    assert re.findall(rf"^\W*({'|'.join(commands)}) ", run("--help").stdout, re.M) == commands


def test_fly_help_lists_every_exit_code() -> None:
    text = run("fly", "--help").stdout
    for code, meaning in EXIT_CODES.items():
        assert re.search(rf"\b{code}  ?{re.escape(meaning[:20])}", text), (code, meaning)
    for option in ("--uri", "--profile", "--source", "--seed", "--log-dir", "--json", "--dry-run"):
        assert option in text
    assert "CFLIB_URI" in text


def test_version() -> None:
    assert run("--version").stdout.strip() == f"perchctl {__version__}"


@pytest.mark.parametrize(
    "arguments",
    [("fly", "--bogus"), ("perch",), ("simulate", "-n", "0"), ("simulate", "--seed", "-1")],
    ids=" ".join,
)
def test_wrong_usage_is_2(arguments: tuple[str, ...]) -> None:
    assert run(*arguments).code == 2


# --- Bad input, before anything is opened ---------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("kalman: {alfa: 0.85}", ["mine.yaml: kalman.alfa", "unknown", "alpha"]),
        (
            "target: {large: {dictionary: DICT_4X4_100, id: 997, side_m: 0.15}}",
            ["target.large", "997", "0..99", "DICT_4X4_1000"],
        ),
        (
            "target: {large: {dictionary: DICT_4X4_1000, id: 1000, side_m: 0.15}}",
            ["target.large", "1000", "0..999"],
        ),
    ],
    ids=["misspelt key", "the paper's dictionary", "id outside"],
)
def test_a_wrong_profile(tmp_path: Path, text: str, words: list[str]) -> None:
    (tmp_path / "mine.yaml").write_text(f"extends: sim\n{text}\n")
    said = run("fly", "-p", str(tmp_path / "mine.yaml"))
    assert said.code == 30
    for word in words:
        assert word in said.complaint


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["fly", "-p", "smi"], 20, ["'smi'", "sim"]),
        (["fly", "-p", "./none.yaml"], 20, ["none.yaml", "does not exist"]),
        (["simulate", "-p", "smi"], 20, ["'smi'", "sim"]),
        (["fly", "--uri", "bogus"], 30, ["'bogus'", "radio://0/80/2M"]),
        (["fly", "--uri", ""], 30, ["radio://0/80/2M"]),
        (["fly", "--uri", "udp://127.0.0.1:99999", "--yes"], 30, ["65535"]),
        (["fly", "--uri", NOWHERE], 2, ["sim:", "--source"]),
        (["fly", "--uri", NOWHERE, "--source", "sim:", "--yes"], 2, ["sim:", "--source"]),
        (["fly", "--source", "webcam"], 30, ["'webcam'", "camera:N"]),
        (["fly", "--source", ""], 30, ["camera:N"]),
        (["fly", "--dry-run", "--source", "webcam"], 30, ["'webcam'", "camera:N"]),
        (["fly", "--seed", "-1"], 30, ["-1", "negative"]),
        (["fly", "--uri", NOWHERE, "--source", "camera:x", "--yes"], 30, ["camera:0"]),
        (["fly", "--uri", NOWHERE, "--source", "camera:9", "--yes"], 20, ["camera:9"]),
        (["fly", "--source", "video:none.mp4"], 20, ["none.mp4"]),
        (["fly", "--source", "images:none"], 20, ["none"]),
        (["fly", "--uri", NOWHERE, "--source", "video:none.mp4"], 2, ["recording", NOWHERE]),
        (["fly", "--uri", NOWHERE, "--source", "images:none", "--yes"], 2, ["recording", "sim://"]),
        (
            ["fly", "-p", "crazyflie", "--source", "video:none.mp4", "--dry-run"],
            2,
            ["recording", "radio://", "--source"],
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else str(value),
)
def test_bad_input(arguments: list[str], code: int, words: list[str]) -> None:
    said = run(*arguments)
    assert said.code == code, said
    for word in words:
        assert word in said.complaint


def test_the_uri_of_the_environment_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CFLIB_URI", "bogus")
    assert run("fly", "--dry-run").code == 30
    assert "udp://h:1" in run("fly", "--dry-run", "-u", "udp://h:1", "--source", "camera:0").stdout


def test_nobody_to_ask_is_no_consent() -> None:
    said = run_apart("fly", "--uri", NOWHERE, "--source", "camera:9")
    assert said.code == 2
    assert "--yes" in said.complaint
    assert NOWHERE in said.complaint


@pytest.mark.parametrize(("answer", "asked"), [("n", True), ("", True), ("y", False)])
def test_only_a_yes_is_consent(
    answer: str, asked: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A yes goes on, here to the missing camera."""
    monkeypatch.setattr("builtins.input", lambda: answer)
    monkeypatch.setattr("sys.stdin", type("Terminal", (), {"isatty": lambda self: True})())
    with pytest.raises(SystemExit) as left:
        app(["fly", "--uri", NOWHERE, "--source", "camera:9"])
    assert left.value.code == (2 if asked else 20)
    said = capsys.readouterr()
    assert ("not confirmed" in said.err) is asked
    assert "Is the space under the target clear?" in said.err
    assert said.out == ""


@pytest.mark.parametrize("where", ["a file", "a folder that may not be made"])
def test_a_log_that_cannot_be_written(where: str, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    folder = tmp_path / "taken" if where == "a file" else Path("/proc/none")
    said = run("fly", "--log-dir", str(folder), "--uri", NOWHERE, "--source", "camera:9", "--yes")
    assert said.code == 30
    assert str(folder) in said.complaint
    assert "log" in said.complaint


# --- The plan ------------------------------------------------------------------------------


def test_dry_run_tells_the_plan_and_connects_nothing(tmp_path: Path) -> None:
    said = run("fly", "-p", SHORT, "--seed", "7", "--dry-run")
    assert said.code == 0
    assert said.stderr == ""
    for word in ("sim://, seed 7", "DICT_4X4_1000/997", "1 APPROACH", "7 COMPLETE", "short.yaml"):
        assert word in said.stdout
    assert list(tmp_path.iterdir()) == []  # no log either


def test_dry_run_as_json_holds_the_whole_profile() -> None:
    plan = json.loads(run("fly", "-p", SHORT, "--dry-run", "--json").stdout)
    assert plan["uri"] == "sim://"
    assert plan["seed"] == PLAIN_SEED
    assert plan["profile"]["simulation"]["camera_rate_hz"] == 20
    assert plan["profile"]["kalman"]["n_max"] == 8
    assert Path(plan["calibration_file"]).is_file()


# --- Bad peers ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def eyes() -> Iterator[str]:
    """A camera that lives, as a source."""
    with SimProcess.start(camera=load_calibration("example_640x480.yaml")) as sim:
        yield sim.stream_url


def test_a_silent_peer(profile: str, eyes: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute:
        mute.bind(("127.0.0.1", 0))
        uri = f"udp://127.0.0.1:{mute.getsockname()[1]}"
        said = run("fly", "-p", profile, "--uri", uri, "--source", eyes, "--yes")
    assert said.code == 10
    assert uri in said.complaint
    assert "no answer within" in said.complaint


def test_a_radio_that_is_not_there(profile: str, eyes: str) -> None:
    uri = "radio://0/80/2M/E7E7E7E7E7"
    said = run("fly", "-p", profile, "--uri", uri, "--source", eyes, "--yes")
    assert said.code == 10
    assert uri in said.stderr
    assert 'ATTRS{idVendor}=="1915", ATTRS{idProduct}=="7777"' in said.stderr
    assert "no Crazyradio is plugged in" in said.stderr


@pytest.mark.parametrize(
    ("link", "code", "words"),
    [
        (
            LinkOptions(missing_log_variables=("stateEstimate.vz",)),
            20,
            ["stateEstimate.vz", "update the firmware"],
        ),
        (LinkOptions(protocol_version=11), 10, ["protocol 11", "12", "update the firmware"]),
    ],
    ids=["a log variable is missing", "old protocol"],
)
def test_an_unfit_firmware(link: LinkOptions, code: int, words: list[str], eyes: str) -> None:
    with SimProcess.start(link=link) as sim:
        said = run("fly", "-p", SHORT, "--uri", sim.uri, "--source", eyes, "--yes")
        assert max(sim.truth()["motors"]) == 0
    assert said.code == code
    for word in words:
        assert word in said.complaint


@pytest.fixture(scope="module")
def grounded() -> Iterator[SimProcess]:
    """A vehicle without a camera of its own, that should never take off."""
    with SimProcess.start() as sim:
        yield sim
        assert sim.truth()["position_m"][2] < 0.05


WRITING = [
    ["calibrate", "images:.", "-o", "OUT.yaml"],
    ["calibrate", "--convert", str(ROOT / "calib/example_640x480.yaml"), "-o", "OUT.yaml"],
    ["calibrate", "images:.", "--mask", "OUT.png"],
    ["make-target", "-o", "OUT.pdf"],
    ["make-target", "--board", "chessboard:9x6:20mm", "-o", "OUT.pdf"],
    ["make-target", "--camera", "example_640x480.yaml", "--plot", "OUT.png"],
    ["make-target", "--measured-large", "150", "-o", "OUT.yaml"],
    ["track", "images:.", "--csv", "OUT.csv"],
    ["track", "images:.", "--overlay", "OUT.mp4"],
    ["fit-weights", "session.csv", "-o", "OUT.yaml"],
    ["fit-weights", "session.csv", "--plot", "OUT.png"],
]
"""Each way to write a file, which is refused before there is anything to work on."""


@pytest.mark.parametrize("words", WRITING, ids=lambda words: f"{words[0]} {words[-2]}")
def test_one_rule_for_what_is_there_already(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    name = words[-1].replace("OUT", "mine")
    words = [*words[:-1], name]
    Path(name).write_text("mine")
    said = run(*words)
    assert said.code == InvalidValue.exit_code
    assert said.complaint == f"{name} exists already; add --force to replace it, or name another"
    assert Path(name).read_text() == "mine"
    assert "exists already" not in run(*words, "--force").stderr
    inside = [*words[:-1], f"{name}/inside/{name}"]
    Path(name).write_text("mine")
    assert "is a file, not a folder" in run(*inside).complaint
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "words",
    [
        ["calibrate", "--convert", str(ROOT / "calib/example_640x480.yaml"), "-o", "OUT.yaml"],
        ["make-target", "--board", "chessboard:9x6:20mm", "-o", "OUT.pdf"],
        ["make-target", "--measured-large", "150", "-o", "OUT.yaml"],
        ["track", "images:pictures", "--stills", "--csv", "OUT.csv"],
        ["fit-weights", "session.csv", "--plot", "OUT.png"],
    ],
    ids=lambda words: f"{words[0]} {words[-2]}",
)
def test_one_rule_for_folders(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if words[0] == "fit-weights":
        write_session(known(positions=4, per=20), Path("session.csv"))
    if words[0] == "track":
        write_pictures(Path("pictures"))
    place = Path(words[-1].replace("OUT", "made/new/out"))
    said = run(*words[:-1], str(place))
    assert said.code == 0, said.stderr
    assert [path.name for path in place.parent.iterdir()] == [place.name]


@pytest.mark.parametrize("name", ["d3.png", "camera", "camera.txt"])
def test_a_calibration_is_not_named_like_its_report(name: str, tmp_path: Path) -> None:
    said = run("calibrate", "images:.", "-o", str(tmp_path / name), "--force")
    assert said.code == InvalidValue.exit_code
    assert "must end in .yaml or .yml" in said.complaint
    assert "report goes beside it as .png" in said.complaint
    assert list(tmp_path.iterdir()) == []


def test_a_calibration_of_another_size(tmp_path: Path) -> None:
    source = pictures(tmp_path / "p", (320, 240))
    said = run("fly", "-p", SHORT, "--source", source)
    assert said.code == 30
    for word in ("320x240", "640x480", "calibrat"):
        assert word in said.complaint


def test_a_recording_that_ends_before_take_off(tmp_path: Path) -> None:
    source = pictures(tmp_path / "p", count=1)
    said = run("fly", "-p", SHORT, "--source", source)
    assert said.code == 20
    assert "ended before take-off" in said.complaint


def test_an_unknown_parameter(grounded: SimProcess, eyes: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(f"extends: {SHORT}\nlink: {{parameters: {{no.such: 1}}}}\n")
    arguments = ["-p", str(tmp_path / "mine.yaml"), "--uri", grounded.uri, "--source", eyes]
    said = run("fly", *arguments, "--yes")
    assert said.code == 20
    assert "no.such" in said.complaint
    assert "link.parameters" in said.complaint


# --- Unforeseen failures ----------------------------------------------------------------------


def test_what_nobody_foresaw_is_one_sentence_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        with reported():
            raise ZeroDivisionError("oh")

    monkeypatch.delenv("PERCHCTL_DEBUG", raising=False)
    with pytest.raises(typer.Exit) as left:
        fail()
    assert left.value.exit_code == 1
    assert "unforeseen ZeroDivisionError: oh" in capsys.readouterr().err
    monkeypatch.setenv("PERCHCTL_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        fail()


def test_ctrl_c_before_the_flight_is_130(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as left, reported():
        raise KeyboardInterrupt
    assert left.value.exit_code == 130
    assert "Ctrl-C" in capsys.readouterr().err


# --- Notes on the profile -----------------------------------------------------------------------


def test_a_note_on_the_profile_is_one_sentence_once(capsys: pytest.CaptureFixture[str]) -> None:
    """Other warnings are left to those who show them: here to pytest, else to Python."""

    def warn() -> None:
        with reported():
            for key in ("a", "b", "a"):
                warnings.warn(f"mine.yaml: {key} has another name", ProfileNote, stacklevel=1)
            warnings.warn("something else", DeprecationWarning, stacklevel=1)

    with pytest.warns(DeprecationWarning, match="something else") as others:
        warn()
    assert len(others) == 1
    assert capsys.readouterr().err == (
        "perchctl: mine.yaml: a has another name\nperchctl: mine.yaml: b has another name\n"
    )
    with pytest.raises(ProfileNote):
        warnings.warn("an error again behind it", ProfileNote, stacklevel=1)


def test_a_note_stands_before_the_sentence_of_a_failure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def load(name: str) -> None:
        warnings.warn(f"{name}: camera.old is camera.new by now", ProfileNote, stacklevel=1)
        raise InvalidValue(f"{name}: no good")

    monkeypatch.setattr("perchctl.commands.fly.load_profile", load)
    said = run("fly", "-p", "mine.yaml", "--dry-run")
    assert said.code == 30
    assert said.stderr.splitlines() == [
        "perchctl: mine.yaml: camera.old is camera.new by now",
        "perchctl: mine.yaml: no good",
    ]


# --- Campaigns ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The campaign's."""
    return tmp_path_factory.mktemp("campaign") / "logs"


@pytest.fixture(scope="module")
def campaign(logs: Path) -> Said:
    """Two seeds, two at a time, with their logs."""
    arguments = ("-p", SHORT, "-n", "2", "--seed", str(SEED), "--jobs", "2", "--json")
    return run_apart("simulate", *arguments, "--log-dir", str(logs))


def test_simulate_prints_one_object(campaign: Said, logs: Path) -> None:
    assert campaign.code == 0
    said = json.loads(campaign.stdout)
    assert set(said) == {
        "flights", "perched", "landed", "aborted", "locked", "fell",
        "miss_m", "realtime_factor", "worst_seeds",
    }  # fmt: skip
    assert set(said["miss_m"]) == {"median", "p95", "max"}
    assert [said[k] for k in ("flights", "perched", "landed", "aborted", "locked", "fell")] == [
        2, 2, 0, 0, 0, 0,
    ]  # fmt: skip
    assert 0 < said["miss_m"]["median"] <= said["miss_m"]["max"] < 0.020
    assert said["realtime_factor"] > 0
    assert said["worst_seeds"] == []
    assert campaign.complaint == f"the flights' logs are in {logs}"


@pytest.fixture(scope="module")
def repeated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Said, Path]:
    """The one flight of the seed, told for people, with its log."""
    folder = tmp_path_factory.mktemp("only") / "made"
    arguments = ("-p", SHORT, "--only", str(SEED), "--log-dir", str(folder))
    return run_apart("simulate", *arguments, PYTHONHASHSEED="7"), folder


def test_one_seed_is_the_flight_that_it_was_in_the_campaign(
    campaign: Said, repeated: tuple[Said, Path], logs: Path
) -> None:
    """The same log, from another process."""
    name = f"flight_seed{SEED}.jsonl"
    assert (repeated[1] / name).read_bytes() == (logs / name).read_bytes()
    assert sorted(path.name for path in logs.iterdir()) == [name, f"flight_seed{SEED + 1}.jsonl"]
    misses = [read_log(path).summary["miss_m"] for path in logs.iterdir()]  # type: ignore[index]
    assert json.loads(campaign.stdout)["miss_m"]["max"] == pytest.approx(max(misses), abs=1e-6)


def test_one_seed_is_told_with_its_phases_log_and_plot(repeated: tuple[Said, Path]) -> None:
    said, folder = repeated
    assert said.code == 0
    assert said.stderr == ""
    lines = said.stdout.splitlines()
    assert lines[0] == "[   0.00 s] APPROACH: start"
    assert re.fullmatch(r"\[ +\d+\.\d\d s\] COMPLETE: contact proven by .*", lines[6])
    assert lines[8] == "PERCHED: hanging still with the motors off"
    words = dict(line.split(":", 1) for line in lines[9:])
    assert set(words) == {"miss", "flight", "phases", "battery", "log", "plot"}
    assert "ALIGN 0.4 s > ASCEND" in words["phases"]
    assert Path(words["log"].strip()) == folder / f"flight_seed{SEED}.jsonl"
    assert Path(words["plot"].strip()) == folder / f"flight_seed{SEED}.png"
    assert {path.suffix for path in folder.iterdir()} == {".jsonl", ".png"}


def test_one_seed_as_json_is_its_flight_logged_where_the_profile_says(tmp_path: Path) -> None:
    profile = tmp_path / "mine.yaml"
    profile.write_text(
        f"extends: {SHORT}\nplanner: {{perching_time_s: 0.3}}\n"
        "log: {directory: here, plot: false}\n"
    )
    said = run("simulate", "-p", str(profile), "--only", "5", "--json")
    record = json.loads(said.stdout)
    assert (said.code, record["seed"], record["outcome"]) == (0, 5, "landed")
    assert record["reason"] == "the perching time is over; motors off"
    assert (record["log"], record["plot"]) == ("here/flight_seed5.jsonl", None)
    assert read_log(tmp_path / record["log"]).header["seed"] == 5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--only 3 -n 5", ["--only 3", "-n 5 does not apply", "leave it out"]),
        ("--only 3 --seed 7", ["--seed 7 does not apply"]),
        ("--only 3 --jobs 2 --seed 0", ["--seed 0 and --jobs 2 do not apply", "leave them out"]),
        ("--only 3 --faults all --heat-map m.png", ["--heat-map m.png does not apply"]),
        ("--faults list --log-dir x", ["flies nothing", "--log-dir x does not apply"]),
        ("--heat-map m.png", ["--faults"]),
    ],
)
def test_options_that_do_not_apply_are_refused(arguments: str, words: list[str]) -> None:
    said = run("simulate", *arguments.split())
    assert said.code == 2
    for word in words:
        assert word in said.complaint
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize("where", ["afile", "afile/logs"])
@pytest.mark.parametrize("command", ["simulate --only 1", "simulate", "fly"])
def test_a_file_in_the_place_of_the_logs_is_named_with_what_to_do(command: str, where: str) -> None:
    Path("afile").touch()
    said = run(*command.split(), "--log-dir", where)
    assert said.code == 30
    assert where in said.complaint
    assert "name another folder with --log-dir" in said.complaint


def test_a_pipe_gets_no_colour(repeated: tuple[Said, Path], campaign: Said) -> None:
    said, _ = repeated
    for text in (said.stdout, said.stderr, campaign.stdout, campaign.stderr):
        assert ESCAPE not in text


def test_the_library_s_tracebacks_stay_away(profile: str, eyes: str, tmp_path: Path) -> None:
    """cflib logs them to the terminal unless it is told not to: seen by a process of its own."""
    for uri, cause in (
        ("radio://0/80/2M/E7E7E7E7E7", "no Crazyradio is plugged in"),
        ("udp://127.0.0.1:9", "nothing listens there"),
    ):
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "perchctl",
                "fly",
                "-p",
                profile,
                "--yes",
                "--uri",
                uri,
                "--source",
                eyes,
            ],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 10, done.stderr
        assert cause in done.stderr
        assert "Traceback" not in done.stderr
        assert "link error callback" not in done.stderr
