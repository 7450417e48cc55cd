"""The command line's edges: help, Tab, failures as JSON, a full disk, Ctrl-C at the wrong time."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from inspect import cleandoc
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.commands import app, complete
from perchctl.commands.fly import fly_and_report, resolve
from perchctl.errors import EXIT_CODES, ConnectionFailed
from perchctl.flight import SessionResult
from perchctl.link.connection import open_connection, plain_cause
from perchctl.mission import FlightReport, Outcome, Phase
from tests.helpers.flights import ROOT

COMMANDS = (
    "make-target",
    "calibrate",
    "profile",
    "fit-weights",
    "track",
    "fly",
    "simulate",
)


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CFLIB_URI", raising=False)


@dataclass(frozen=True)
class Done:
    code: int
    stdout: str
    stderr: str


def run_apart(
    *arguments: str, before: str = "", stdout: Any = subprocess.PIPE, **environment: str
) -> Done:
    """The console script's own entry in a process of its own; `before` is run first."""
    code = f"{before}\nimport sys\nfrom perchctl.__main__ import main\nsys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
    )
    assert "Traceback" not in done.stderr, done.stderr
    return Done(done.returncode, done.stdout or "", done.stderr)


# --- Help --------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_is_whole_at_80_columns(command: str) -> None:
    """Nothing is cut, no line is over, and paragraphs are filled."""
    words = [command, "--help"] if command else ["--help"]
    text = CliRunner().invoke(app, words, env={"COLUMNS": "80"}).stdout
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
    assert max(map(len, text.splitlines())) <= 80
    (about,) = [c.callback.__doc__ for c in app.registered_commands if c.name == command] or [None]
    for paragraph in cleandoc(about or "").split("\n\n"):
        filled = [textwrap.indent(textwrap.fill(paragraph, room), "  ") for room in (76, 78)]
        assert any(each in text for each in filled)
    if not command:
        summaries = [cleandoc(c.callback.__doc__).split("\n\n")[0] for c in app.registered_commands]
        assert all(summary in " ".join(text.split()) for summary in summaries)


def test_help_holds_the_whole_notations_and_one_line_an_exit_code() -> None:
    text = CliRunner().invoke(app, ["calibrate", "--help"], env={"COLUMNS": "80"}).stdout
    assert "[default: charuco:10x7:25mm:18mm:DICT_5X5_100]" in " ".join(text.split())
    lines = CliRunner().invoke(app, ["fly", "--help"], env={"COLUMNS": "80"}).stdout.splitlines()
    first = lines.index("  Exit codes:") + 1
    table = [line.split(maxsplit=1) for line in lines[first : first + len(EXIT_CODES)]]
    assert {int(code): meaning for code, meaning in table} == EXIT_CODES


def test_perchctl_alone_shows_what_there_is() -> None:
    alone = run_apart()
    assert alone.code == 0
    assert alone.stderr == ""
    for command in COMMANDS:
        assert f"\n  {command} " in alone.stdout


# --- Tab -----------------------------------------------------------------------------------


def offered(*words: str) -> list[str]:
    """What bash is told for the last of the words."""
    done = run_apart(
        before="import sys; sys.argv[0] = 'perchctl'",
        _PERCHCTL_COMPLETE="complete_bash",
        COMP_WORDS="\n".join(["perchctl", *words]),
        COMP_CWORD=str(len(words)),
    )
    assert done.stderr == ""
    return done.stdout.split()


def test_tab_offers_profiles_and_sources(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("extends: sim\n")
    (tmp_path / "notes.txt").write_text("")
    (tmp_path / "pictures").mkdir()
    assert offered("fly", "--profile", "") == [
        "aideck", "crazyflie", "extreme", "fpv", "paper", "rough", "sim", "target_only",
        "mine.yaml", "pictures/",
    ]  # fmt: skip
    assert offered("make-target", "-p", "cr") == ["crazyflie"]
    assert offered("track", "im") == ["images:"]


def test_tab_offers_subcommands_and_what_the_main_one_takes(tmp_path: Path) -> None:
    assert offered("simulate", "com") == ["compare"]
    assert offered("profile", "") == ["show", "new", "schema"]
    assert offered("calibrate", "im") == ["images:"]
    assert "--faults" in offered("simulate", "--fa")
    assert "--part" in offered("calibrate", "mount", "--pa")


def test_tab_offers_cameras_that_are_there_and_files_behind_a_colon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    devices = tmp_path / "dev"
    devices.mkdir()
    for name in ("video10", "video2", "video-x"):
        (devices / name).write_text("")
    monkeypatch.setattr(complete, "_DEVICES", devices)
    assert complete.sources("ca") == ["camera:2", "camera:10"]
    (tmp_path / "a.mp4").write_text("")
    assert complete.sources("video:") == ["video:a.mp4", "video:dev/"]
    (tmp_path / "a.txt").write_text("")
    assert complete.sources("./a") == ["./a.mp4"]
    assert complete.sources("[") == []


def test_completion_can_be_installed() -> None:
    assert "--install-completion" in run_apart("--help").stdout
    shown = run_apart("--show-completion", "bash", before="import sys; sys.argv[0] = 'perchctl'",
                      _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1")  # fmt: skip
    assert "complete -o default -F _perchctl_completion perchctl" in shown.stdout


# --- --json ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["fly", "-p", "smi"], 20),
        (["fly", "--dry-run", "--uri", "bogus"], 30),
        (["fly", "--bogus"], 2),
        (["simulate", "-p", "smi"], 20),
        (["simulate", "-n", "0"], 2),
        (["track", "none.png"], 20),
        (["track"], 2),
        (["calibrate"], 2),
        (["calibrate", "images:none"], 20),
        (["make-target", "--large", "3 miles"], 30),
        (["fit-weights"], 2),
        (["fit-weights", "none.csv"], 20),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else str(value),
)
def test_a_failure_is_one_object_too(words: list[str], code: int) -> None:
    done = CliRunner().invoke(app, [*words, "--json"])
    assert done.exit_code == code
    told = json.loads(done.stdout)
    assert set(told) == {"error", "exit_code"}
    assert told["exit_code"] == code
    assert told["error"] in done.stderr
    assert not CliRunner().invoke(app, words).stdout


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)
def test_the_library_s_prints_stay_off_stdout(capfd: pytest.CaptureFixture[str]) -> None:
    """cflib tells of its sockets on stdout, where the one object belongs. (It leaves one open.)"""
    with pytest.raises(ConnectionFailed, match="nothing listens there"):
        open_connection("tcp://127.0.0.1:9", 5.0)
    assert capfd.readouterr().out == ""
    gc.collect()


def test_a_usb_cable_without_rights_gets_the_remedy() -> None:
    said = plain_cause("Couldn't load link driver: Could not open usb://0\n\nTraceback ...")
    assert "no Crazyflie is plugged in by USB" in said
    assert 'ATTRS{idVendor}=="0483", ATTRS{idProduct}=="5740"' in said
    assert "udevadm control --reload-rules" in said


# --- After the flight --------------------------------------------------------------------------


LANDED = FlightReport(Phase.LANDED, Outcome.OPERATOR, "Ctrl-C", 0, 3.0, False)


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A flight that has ended, as `fly` gets it; the list is what happened, in order."""
    happened: list[str] = []

    def session(*_arguments: object) -> SessionResult:
        return SessionResult(LANDED)

    def tell(text: str) -> None:
        happened.append(text)

    monkeypatch.setattr("perchctl.commands.fly.fly_session", session)
    monkeypatch.setattr("perchctl.commands.fly.tell", tell)
    return happened


def test_ctrl_c_in_the_drawing_leaves_the_result(
    flown: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has been told before the drawing begins, and the object follows without a plot."""

    def draw(*_arguments: object) -> None:
        assert flown
        assert flown[0].startswith("LANDED: Ctrl-C")
        os.kill(os.getpid(), 2)  # Ctrl-C

    monkeypatch.setattr("perchctl.analysis.plot_flight", draw)
    code = fly_and_report(resolve(), True, None)
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert (code, told["exit_code"], told["outcome"], told["plot"]) == (130, 130, "landed", None)
    assert told["error"] == f"{EXIT_CODES[130]}: Ctrl-C"
    assert "the plot is not drawn" in err


def test_the_object_names_the_plot(
    flown: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("perchctl.analysis.plot_flight", lambda *_: None)
    fly_and_report(resolve(), True, None)
    told = json.loads(capsys.readouterr().out)
    assert told["plot"] == told["log"].replace(".jsonl", ".png")
    assert flown[-1] == f"plot:      {told['plot']}"


def test_ctrl_c_behind_the_landing_does_not_replace_the_result(
    flown: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pressed while the log is closed, which may take seconds on a slow disk."""
    from perchctl.log import LogWatcher

    close = LogWatcher.close

    def slow(self: LogWatcher, *arguments: Any) -> Any:
        os.kill(os.getpid(), 2)
        return close(self, *arguments)

    monkeypatch.setattr(LogWatcher, "close", slow)
    monkeypatch.setattr("perchctl.analysis.plot_flight", lambda *_: None)
    assert fly_and_report(resolve(), True, None) == 130
    assert json.loads(capsys.readouterr().out)["outcome"] == "landed"


# --- Start ----------------------------------------------------------------------------------


PRESSED_AT = """
    import importlib.abc, os, signal, sys

    class Presser(importlib.abc.MetaPathFinder):
        def find_spec(self, name, path, target=None):
            if name == {module!r}:
                os.kill(os.getpid(), signal.SIGINT)

    sys.meta_path.insert(0, Presser())
"""


@pytest.mark.parametrize("module", ["typer", "numpy", "cv2", "pydantic"])
def test_ctrl_c_while_loading_is_one_sentence(module: str) -> None:
    before = textwrap.dedent(PRESSED_AT.format(module=module))
    done = run_apart("fly", "--dry-run", before=before)
    assert (done.code, done.stdout, done.stderr) == (130, "", "perchctl: Ctrl-C\n")


def test_ctrl_c_while_loading_is_an_object_where_one_is_wanted() -> None:
    before = textwrap.dedent(PRESSED_AT.format(module="numpy"))
    done = run_apart("fly", "--dry-run", "--json", before=before)
    assert json.loads(done.stdout) == {"error": "Ctrl-C", "exit_code": 130}


def test_an_ignored_ctrl_c_stays_ignored() -> None:
    """As a shell starts what it puts into the background."""
    ignored = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
    before = ignored + textwrap.dedent(PRESSED_AT.format(module="numpy"))
    assert run_apart("fly", "--dry-run", before=before).code == 0


# --- A full disk --------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    "words", [["--help"], ["fly", "--dry-run"], ["fly", "--dry-run", "--json"]]
)
def test_a_full_disk_behind_stdout_is_30_as_everywhere(words: list[str]) -> None:
    with open("/dev/full", "w") as full:
        done = run_apart(*words, stdout=full)
    assert done.code == 30
    assert done.stderr == (
        "perchctl: the result cannot be written: No space left on device: free some space\n"
    )


def test_a_path_beyond_all_bounds_is_one_short_sentence() -> None:
    done = CliRunner().invoke(app, ["fly", "--dry-run", "-p", f"./{'x' * 3000}.yaml"])
    assert done.exit_code == 30
    assert "File name too long" in done.stderr
    assert len(done.stderr) < 400
