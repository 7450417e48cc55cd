"""The command line: its help, its exit codes, and one sentence for each bad input."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl import __version__
from perchctl.calibration import load_calibration
from perchctl.commands import app
from perchctl.commands.command_line import COMMANDS, reported
from perchctl.commands.output import confirmed
from perchctl.errors import EXIT_CODES, Interrupted
from perchctl.flight import PLAIN_SEED
from perchctl.sim import SimProcess
from perchctl.sim.crtp.server import LinkOptions
from tests.helpers.commands import elsewhere, run, run_apart  # noqa: F401
from tests.helpers.flights import ROOT, SHORT

HEAVY = ("cv2", "numpy", "cflib", "matplotlib", "mujoco", "pydantic", "filterpy", "scipy")
NOWHERE = "udp://127.0.0.1:9"


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
        "from perchctl.commands import main\n"
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
    commands = ["make-target", "calibrate", "profile"]
    commands += ["fit-weights", "track", "fly", "simulate"]
    assert re.findall(rf"^\W*({'|'.join(commands)}) ", run("--help").stdout, re.M) == commands


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_has_the_first_sentence_of_each_help(name: str) -> None:
    shown = " ".join(run(name, "--help").stdout.split())
    assert COMMANDS[name][1] in shown


@pytest.mark.parametrize("name", COMMANDS)
def test_each_help_fits_a_terminal_of_80_columns(name: str) -> None:
    helps = [run(name, "--help").stdout]
    listed = re.split(r"Subcommands; without one it is \w+:|Commands:", helps[0])[1:]
    subcommands = re.findall(r"^  (\w+)  ", listed[0], re.M) if listed else []
    helps += [run(name, each, "--help").stdout for each in subcommands]
    for line in "".join(helps).splitlines():
        assert len(line) <= 80, line


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
        (["fly", "--uri", NOWHERE, "--source", "camera:x", "--yes"], 20, ["camera:x"]),
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


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", type("Terminal", (), {"isatty": lambda self: True})())


@pytest.mark.usefixtures("terminal")
def test_nobody_is_asked_before_the_camera_answers(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("builtins.input", pytest.fail)
    with pytest.raises(SystemExit) as left:
        app(["fly", "--uri", NOWHERE, "--source", "camera:9"])
    assert left.value.code == 20
    assert "clear?" not in capsys.readouterr().err


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize(("answer", "flies"), [("n", False), ("", False), ("y", True)])
def test_only_a_yes_is_consent(
    answer: str, flies: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def flown(*_: object) -> None:
        raise Interrupted("it would fly")

    camera = load_calibration("example_640x480.yaml")
    with SimProcess.start(camera=camera) as vehicle:
        monkeypatch.setattr("builtins.input", lambda: answer)
        monkeypatch.setattr("perchctl.flight.session.fly", flown)
        with pytest.raises(SystemExit) as left:
            app(["fly", "--uri", vehicle.uri, "--source", vehicle.stream_url])
    assert left.value.code == (130 if flies else 2)
    said = capsys.readouterr()
    assert "Is the space under the target clear?" in said.err
    assert ("not confirmed" in said.err) is not flies
    assert ("it would fly" in said.err) is flies
    assert said.out == ""


def test_what_was_typed_before_the_question_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    pty = pytest.importorskip("pty", reason="Windows has no terminals of this kind")
    keyboard, screen = pty.openpty()
    os.write(keyboard, b"y\n")

    class Reader:
        """Types no as soon as the question has appeared."""

        def write(self, text: str) -> int:
            if "?" in text:
                os.write(keyboard, b"n\n")
            return len(text)

        def flush(self) -> None:
            return None

    with open(screen, encoding="utf-8") as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        monkeypatch.setattr("sys.stderr", Reader())
        assert not confirmed("Is it clear?")
        os.write(keyboard, b"yes\n")
        assert stdin.readline() == "yes\n"  # nothing of before is left
    os.close(keyboard)


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
    for line in (
        "gear         tip at 0 0 30 mm",
        "mounting     camera at 30 0 5 mm, rpy 0 0 0 deg",
        "             picture's right is the front, bottom the left side",
        "latency      75 ms",
        "fence        2 m",
        "height       at most 3 m",
        "battery      at least 3.8 V at rest, 3 V in flight",
    ):
        assert f"\n{line}" in said.stdout
    assert "warn" not in said.stdout
    real = run("fly", "-p", SHORT, "-u", "usb://0", "--source", "camera:0", "--dry-run")
    assert "\nwarn         calibration file: example_640x480.yaml" in real.stdout
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
    uri = "radio://0/80/2M/E7E7E7E7E7"
    said = run("fly", "-p", profile, "--uri", uri, "--source", eyes, "--yes")
    assert said.code == 10
    assert uri in said.stderr
    assert 'ATTRS{idVendor}=="1915", ATTRS{idProduct}=="7777"' in said.stderr
    assert "no Crazyradio is plugged in" in said.stderr


@pytest.mark.long
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


@pytest.mark.long
def test_a_calibration_of_another_size(tmp_path: Path) -> None:
    source = pictures(tmp_path / "p", (320, 240))
    said = run("fly", "-p", SHORT, "--source", source)
    assert said.code == 30
    for word in ("320x240", "640x480", "calibrat"):
        assert word in said.complaint


@pytest.mark.long
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


# --- Options that would not be heeded -------------------------------------------------------------


@pytest.mark.long
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


def test_the_help_of_simulate_needs_no_simulator() -> None:
    hide = (
        "import sys\nsys.modules['mujoco'] = None\nsys.argv = ['perchctl', 'simulate', '--help']\n"
        "from perchctl.__main__ import main\nsys.exit(main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", hide],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert "Usage: perchctl simulate" in done.stdout
