"""What all subcommands share: help, usage, failures as sentences and JSON, notes, what is written,
a full disk, Ctrl-C at the wrong time."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import sys
import textwrap
import warnings
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest
import typer

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl import __version__
from perchctl.commands.command_line import COMMANDS, report_failures
from perchctl.commands.output import ask, ask_to_confirm, say
from perchctl.commands.progress import done_of_total_bar
from perchctl.errors import EXIT_CODES, InvalidValue, ProfileNote, UsageError
from perchctl.startup import is_command_line
from tests.helpers.commands import elsewhere, run, run_apart  # noqa: F401
from tests.helpers.flights import ROOT

HEAVY = ("cv2", "numpy", "cflib", "matplotlib", "mujoco", "pydantic", "filterpy", "scipy")


# --- Help and usage ------------------------------------------------------------------------


def test_help_loads_nothing_heavy() -> None:
    """It answers in under 0.3 s because of what it does not import."""
    before = (
        "import atexit, sys\n"
        f"atexit.register(lambda: print([m for m in {HEAVY!r} if m in sys.modules]))"
    )
    done = run_apart("--help", before=before)
    assert "simulate" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


UNTIL_HEAVY = """
import contextlib, importlib.abc, io, json, sys

class HeavyImport(BaseException):
    pass

class Guard(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name in {heavy!r}:
            raise HeavyImport(name)

class Terminal(io.StringIO):
    def isatty(self):
        return True

sys.meta_path.insert(0, Guard())
from perchctl.commands import app

for line in {lines!r}:
    with contextlib.redirect_stdout(Terminal()) as said, contextlib.redirect_stderr(said):
        try:
            app(line.split())
        except BaseException as error:
            end = type(error).__name__
    print(json.dumps([line, end, said.getvalue()]))
sys.exit()
"""
"""Runs each command until it loads a heavy library; prints how it ended, and what it printed."""

FIRST_WORDS = {
    "make-target sheet": "reading profile sim",
    "make-target board chessboard:9x6:25mm": "reading board chessboard:9x6:25mm",
    "make-target design": "reading profile sim",
    "make-target measured -p mine.yaml --measured-large 149.6": "reading profile mine.yaml",
    "calibrate camera images:.": "looking for the board",
    "calibrate mount -p mine.yaml": "reading profile mine.yaml",
    "calibrate mask images:.": "looking for the parts that the vehicle covers",
    "calibrate check mine.yaml images:.": "reading mine.yaml",
    "calibrate convert mine.yaml": "reading mine.yaml",
    "profile show": "reading profile sim",
    "profile new": "reading the shipped profiles",
    "profile schema": "listing the keys of a profile",
    "fit-weights fit data.csv": "reading data.csv",
    "fit-weights collect data.csv": "reading profile sim",
    "track images:.": "reading profile sim",
    "check": "reading profile sim",
    "check --cameras": "listing the cameras",
    "check --scan": "scanning all channels and rates",
    "fly": "reading profile sim",
    "hover": "reading profile sim",
    "fleet check": "reading the example fleet",
    "fleet fly mine.yaml": "reading fleet mine.yaml",
    "fleet simulate": "reading the example fleet",
    "fleet simulate --faults list": "listing the faults",
    "fleet convert lab.yaml": "reading lab.yaml",
    "simulate run": "reading profile sim",
    "simulate compare sim paper": "reading profiles sim and paper",
    "simulate sweep link.uri=a,b": "reading profile sim",
    "simulate --faults list": "listing the faults",
    "log show": "looking for the newest log",
    "log plot a.jsonl": "reading a.jsonl",
    "log compare a.jsonl b.jsonl": "reading a.jsonl and b.jsonl",
    "log export a.jsonl": "reading a.jsonl",
    "log replay a.jsonl": "reading a.jsonl",
    "log report a.jsonl": "reading a.jsonl",
    "log film a.jsonl": "reading a.jsonl",
}


def subcommands() -> Iterator[str]:
    """Each command with its subcommands, as one types it."""
    for name in COMMANDS:
        module = import_module(f"perchctl.commands.{name.replace('-', '_')}")
        inner = getattr(typer.main.get_command(module.app), "commands", None)
        yield from [name] if inner is None else [f"{name} {each}" for each in inner]


def test_the_first_word_and_each_help_need_no_heavy_library() -> None:
    """To load one takes a second and more on a small computer; typer itself loads pydantic."""
    assert [name for name in subcommands() if not any(f"{line} ".startswith(f"{name} ")
            for line in FIRST_WORDS)] == []  # fmt: skip
    lines = [*FIRST_WORDS, *(f"{name} --help" for name in subcommands())]
    heavy = {*HEAVY, "rich.console"} - {"pydantic"}
    done = run_apart(before=UNTIL_HEAVY.format(heavy=heavy, lines=lines))
    said = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line for line, _, _ in said] == lines
    for line, error, output in said:
        if line in FIRST_WORDS:
            assert (error, output) == ("HeavyImport", f"perchctl: {FIRST_WORDS[line]}\n"), line
        else:
            assert (error, "Examples:" in output) == ("SystemExit", True), line


def test_perchctl_alone_lists_the_commands_in_the_order_of_use() -> None:
    alone = run()
    assert (alone.code, alone.stderr) == (0, "")
    assert alone.stdout == run("--help").stdout
    listed = re.findall(rf"^  ({'|'.join(COMMANDS)})  ", alone.stdout, re.MULTILINE)
    assert listed == list(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_each_help_is_whole_at_80_columns(name: str) -> None:
    """It begins as the list says; nothing is cut, no line is over; each has its examples."""
    helps = [run(name, "--help").stdout]
    assert COMMANDS[name] in " ".join(helps[0].split())
    listed = helps[0].partition("Subcommands (default:")[2]
    helps += [run(name, each, "-h").stdout for each in re.findall(r"^  (\w+)  ", listed, re.M)]
    for text in helps:
        assert "\N{HORIZONTAL ELLIPSIS}" not in text
        assert max(map(len, text.splitlines())) <= 80
        assert "Examples:\n    perchctl " in text


def test_the_help_of_a_main_subcommand_begins_with_its_own_sentence() -> None:
    for name, begins, goes_on in (
        ("fleet check", "Plan a fleet's flight", "By default (subcommand check), perchctl reads"),
        ("log show", "Show how and", "All subcommands read the logs of real and simulated"),
    ):
        done = run(*name.split(), "--help")
        assert done.stdout.splitlines()[2].strip().startswith(begins)
        assert f"\n\n  {goes_on}" in done.stdout
    usage = run("fleet", "check", "--help").stdout.splitlines()[0]
    assert usage.endswith("fleet check [OPTIONS] [FLEET.yaml]")


def test_fly_help_lists_every_exit_code_in_a_line() -> None:
    text = run("fly", "--help").stdout
    lines = text.splitlines()
    first = lines.index("  Exit codes:") + 1
    table = [line.split(maxsplit=1) for line in lines[first : first + len(EXIT_CODES)]]
    assert {int(code): meaning for code, meaning in table} == EXIT_CODES
    assert "CFLIB_URI" in text


def test_wrong_usage_is_2() -> None:
    for words in (
        "fly --bogus",
        "perch",
        "fly --seed",
        "calibrate camera:0 --size 640",
        "calibrate",
    ):
        assert run(*words.split()).code == 2
    assert run("--version").stdout.strip() == f"perchctl {__version__}"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("simulate -n 0", "-n/--flights: found '0'; allowed are whole numbers of 1 or more"),
        ("simulate --seed -1", "--seed: found '-1'; allowed are whole numbers of 0 or more"),
        ("fly --seed -3", "--seed: found '-3'; allowed are whole numbers of 0 or more"),
        ("fly --seed one", "--seed: found 'one'; allowed are whole numbers of 0 or more"),
        ("log film --rate 100", "--rate: found '100'; allowed are numbers from 1 to 60"),
        (
            "log film --width 1.5",
            "--width: found '1.5'; allowed are whole numbers from 320 to 1920",
        ),
        ("calibrate camera:0 --size 640 x", "--size: found 'x'; allowed are whole numbers"),
        (
            "fit-weights x.csv --method magic",
            "--method: found 'magic'; allowed are closed_form, lms",
        ),
        *(
            (f"{command} {setting}", f"{setting} must be KEY=VALUE")
            for command in ("profile new --defaults --set", "simulate sweep")
            for setting in ("link.uri", "=3")
        ),
    ],
)
def test_an_option_with_a_wrong_value_is_30_and_says_what_is_allowed(
    words: str, sentence: str
) -> None:
    done = run(*words.split(), *(["--json"] if "fly" in words else []))
    assert done.code == 30
    assert sentence in done.complaint.replace(",VALUE", "")
    assert not list(Path().iterdir())


# --- Failures ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("fly -p smi", 20),
        ("fly --dry-run --uri bogus", 30),
        ("fly --bogus", 2),
        ("simulate -p smi", 20),
        ("track none.png", 20),
        ("calibrate", 2),
        ("calibrate images:. -o camera.txt", 30),
        ("make-target design none.yaml", 20),
        ("fit-weights", 2),
    ],
)
def test_a_failure_is_one_object_too(words: str, code: int) -> None:
    done = run(*words.split(), "--json")
    assert done.code == code
    told = json.loads(done.stdout)
    assert set(told) == {"error", "exit_code"}
    assert told["exit_code"] == code
    assert told["error"] in done.stderr
    assert not run(*words.split()).stdout


def test_what_nobody_foresaw_is_one_sentence_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        with report_failures():
            raise ZeroDivisionError("oh")

    monkeypatch.delenv("PERCHCTL_DEBUG", raising=False)
    with pytest.raises(typer.Exit) as left:
        fail()
    assert left.value.exit_code == 1
    assert "unexpected ZeroDivisionError: oh" in capsys.readouterr().err
    monkeypatch.setenv("PERCHCTL_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        fail()


def test_each_note_is_one_sentence_once_and_before_a_failure(
    capsys: pytest.CaptureFixture[str],
) -> None:
    @report_failures()
    def fail() -> None:
        for key in ("a", "b", "a"):
            warnings.warn(f"mine.yaml: {key} has another name", ProfileNote, stacklevel=1)
        raise InvalidValue("no good")

    with pytest.raises(typer.Exit):
        fail()
    assert capsys.readouterr().err.splitlines() == [
        "perchctl: mine.yaml: a has another name",
        "perchctl: mine.yaml: b has another name",
        "perchctl: no good",
    ]
    with pytest.raises(ProfileNote):
        warnings.warn("an error again behind it", ProfileNote, stacklevel=1)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("simulate --resume", ["--resume", "--out"]),
        ("calibrate pictures --view", ["not a live camera", "--view"]),
    ],
)
def test_options_that_would_not_be_heeded_are_refused(line: str, words: list[str]) -> None:
    Path("pictures").mkdir()
    said = run(*line.split())
    assert said.code == 2
    for word in words:
        assert word in said.complaint


# --- On a terminal -------------------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("total", "shown"), [(None, " 2"), (3, " 2/3")])
def test_a_bar_shows_the_total_if_it_is_known(
    total: int | None, shown: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    with done_of_total_bar("flights", total) as progress:
        progress(2, total)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", screen.getvalue())
    assert text.rstrip().endswith(shown)


def test_a_message_breaks_between_words_but_only_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = "/home/somebody/" + "a_long_folder/" * 7 + "flight.jsonl"
    copied = "  SUBSYSTEM==usb, " + "ATTRS==1915, " * 8 + "MODE==0664"
    sentence = f"the newest log of all the flights that were flown today: {path}: it ends\n{copied}"

    monkeypatch.setenv("COLUMNS", "80")
    terminal, pipe = Terminal(), io.StringIO()
    for stream in (terminal, pipe):
        monkeypatch.setattr("sys.stderr", stream)
        say(sentence)
    assert pipe.getvalue() == f"perchctl: {sentence}\n"
    assert terminal.getvalue().splitlines() == [
        "perchctl: the newest log of all the flights that were flown today:",
        f"          {path}:",
        "          it ends",
        copied,
    ]


# --- Questions -----------------------------------------------------------------------------


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
        assert not ask_to_confirm("Is it clear?")
        os.write(keyboard, b"yes\n")
        assert stdin.readline() == "yes\n"  # nothing of before is left
    os.close(keyboard)


def test_a_question_on_a_terminal_has_line_editing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of input() itself, which must know its prompt to draw the line again."""
    prompts: list[str] = []
    for stream in ("sys.stdin", "sys.stdout"):
        monkeypatch.setattr(f"{stream}.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda *prompt: prompts.append(*prompt) or "0.1")
    monkeypatch.delitem(sys.modules, "readline", raising=False)
    assert ask("How high?\n  [2.4 m]") == "0.1"
    assert (prompts, capsys.readouterr().err) == (["  [2.4 m] "], "How high?\n")
    assert "readline" in sys.modules


# --- What is written -----------------------------------------------------------------------

CALIBRATION = str(ROOT / "calib/example_640x480.yaml")
WRITING = [
    "calibrate images:. -o OUT.yaml",
    f"calibrate convert {CALIBRATION} -o OUT.yaml",
    "calibrate mask images:. -o OUT.png",
    "make-target -o OUT.pdf",
    "make-target board chessboard:9x6:20mm -o OUT.pdf",
    "fit-weights session.csv -o OUT.yaml",
]
"""Each way to write a file, which is refused before there is anything to work on."""


@pytest.mark.parametrize("line", WRITING)
def test_one_rule_for_what_is_there_already(line: str) -> None:
    *words, out = line.split()
    name = out.replace("OUT", "mine")
    Path(name).write_text("mine")
    said = run(*words, name)
    assert said.code == InvalidValue.exit_code
    assert f"{name} already exists; add --force" in said.complaint
    assert Path(name).read_text() == "mine"
    assert "already exists" not in run(*words, name, "--force").stderr
    Path(name).write_text("mine")
    assert "is a file, not a folder" in run(*words, f"{name}/inside/{name}").complaint
    assert "folder prits does not exist" in run(*words, f"prits/{name}").complaint
    assert [path.name for path in Path().iterdir()] == [name]


# --- A file of another kind ----------------------------------------------------------------

LOG = '{"kind":"header","format":"perchctl-flight-log","version":3}\n{}\n'


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("fly -p a.jsonl", "a.jsonl is not a profile (it is a flight log)"),
        ("fly -p ./a.jsonl", "a.jsonl is not a profile (it is a flight log)"),
        ("fly -p b.jsonl", "b.jsonl is not a profile (it is a JSON file)"),
        ("fly -p ./b.jsonl", "b.jsonl is not a profile (it is a JSON file)"),
        ("fleet check a.jsonl", "a.jsonl is not a fleet file (it is a flight log)"),
        (
            "calibrate mount -p sim --from a.jsonl",
            "a.jsonl is not a recording from calibrate mount (it is a flight log)",
        ),
        ("calibrate mount -p sim --from b.jsonl", "b.jsonl, line 1 is not a line of"),
        ("log show m.jsonl", "(it is a recording from calibrate mount)"),
        (f"profile -p {ROOT}/fleets/four.yaml", "is a fleet file, not a profile"),
        (f"fly -p {CALIBRATION}", "is a camera calibration, not a profile"),
        (f"fleet check {ROOT}/profiles/sim.yaml", "(it is a profile)"),
        (
            "make-target design a.jsonl",
            "a.jsonl is not a camera calibration (it is a flight log)",
        ),
        ("track a.jsonl", "neither a picture nor a video (it is a flight log)"),
        ("fit-weights a.jsonl", "(it is a flight log)"),
        (f"log show {ROOT}/profiles/sim.yaml", "not a perchctl flight log (it is a profile);"),
    ],
)
def test_a_file_of_another_kind_is_named(line: str, words: str) -> None:
    Path("a.jsonl").write_text(LOG)
    Path("b.jsonl").write_text('{"a": 1}\n{"b": 2}\n')
    Path("m.jsonl").write_text('{"part":"carry","mirrored_pictures":0}\n')
    said = run(*line.split())
    assert said.code == InvalidValue.exit_code
    assert words in said.complaint
    assert "not YAML" not in said.complaint


def test_swapped_arguments_are_put_right() -> None:
    said = run("calibrate", "check", "images:board", CALIBRATION)
    assert said.code == UsageError.exit_code
    assert f"perchctl calibrate check {CALIBRATION} images:board" in said.complaint


# --- A full disk, and Ctrl-C while it loads -------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("words", ["--help", "fly --dry-run", "fly --dry-run --json"])
def test_a_full_disk_behind_stdout_is_30_as_everywhere(words: str) -> None:
    with open("/dev/full", "w") as full:
        done = run_apart(*words.split(), stdout=full)
    assert done.code == 30
    assert done.complaint.startswith("the result cannot be written: No space left on device")


PRESSED_AT = """
    import importlib.abc, os, signal, sys

    class Presser(importlib.abc.MetaPathFinder):
        def find_spec(self, name, path, target=None):
            if name == {module!r}:
                os.kill(os.getpid(), signal.SIGINT)

    sys.meta_path.insert(0, Presser())
"""


def pressed_at(module: str) -> str:
    return textwrap.dedent(PRESSED_AT.format(module=module))


@pytest.mark.parametrize("module", ["lazy_loader", "typer", "cv2"])
def test_ctrl_c_while_loading_is_one_sentence(module: str) -> None:
    done = run_apart("fly", "--dry-run", before=pressed_at(module))
    assert (done.code, done.stdout, done.stderr) == (130, "", "perchctl: Ctrl-C\n")


def test_ctrl_c_while_loading_is_an_object_where_one_is_wanted() -> None:
    done = run_apart("fly", "--dry-run", "--json", before=pressed_at("numpy"))
    assert json.loads(done.stdout) == {"error": "Ctrl-C", "exit_code": 130}


@pytest.mark.long
def test_an_ignored_ctrl_c_stays_ignored() -> None:
    """As a shell starts what it puts into the background."""
    ignored = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
    assert run_apart("fly", "--dry-run", before=ignored + pressed_at("numpy")).code == 0


@pytest.mark.parametrize(
    ("name", "started", "mine"),
    [("/bin/perchctl", "/bin/perchctl", True), ("-m", "-m perchctl", True),
     ("perchctl_notes.py", "perchctl_notes.py", False), ("-m", "-m notes perchctl", False)],
)  # fmt: skip
def test_a_program_that_imports_perchctl_keeps_its_ctrl_c(
    monkeypatch: pytest.MonkeyPatch, name: str, started: str, mine: bool
) -> None:
    monkeypatch.setattr(sys, "argv", [name, *started.split()[1 + (name == "-m") :]])
    monkeypatch.setattr(sys, "orig_argv", ["python", *started.split()])
    monkeypatch.delitem(sys.modules, "multiprocessing", raising=False)
    assert is_command_line() is mine


# --- Windows ---------------------------------------------------------------------------------

AS_ON_WINDOWS = """
import sys
sys.platform = "win32"
lacks = ["fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"]
sys.modules.update(dict.fromkeys(lacks))  # an ImportError each
"""


@pytest.mark.parametrize("words", [*COMMANDS, "log report", "calibrate mount", "--help"])
def test_windows_is_refused_in_one_sentence_with_a_way_to_go_on(words: str) -> None:
    done = run_apart(*words.split(), "--json", before=AS_ON_WINDOWS)
    assert done.code == 1
    assert done.complaint.startswith("Windows is not supported: install perchctl in WSL2")
    assert json.loads(done.stdout) == {"error": done.complaint, "exit_code": 1}


@pytest.mark.parametrize("use", ["from perchctl import fly", "import perchctl; perchctl.fly"])
def test_a_program_on_windows_is_told_too(use: str) -> None:
    shows = "except ImportError as error: sys.exit(f'perchctl: {error}')"
    done = run_apart(before=f"{AS_ON_WINDOWS}\ntry: {use}\n{shows}")
    assert done.complaint.startswith("Windows is not supported")


# --- Misspelt commands -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("fyl",), "Did you mean 'fly'"),
        (("log", "shwo"), "did you mean show?"),
        (("calibrate", "monut", "-p", "x.yaml"), "did you mean mount?"),
    ],
)
def test_a_misspelt_command_is_named(words: tuple[str, ...], meant: str) -> None:
    said = run(*words)
    assert said.code == UsageError.exit_code
    assert meant in said.stderr


def test_what_is_like_no_command_is_the_main_ones_argument(tmp_path: Path) -> None:
    """A file may have a command's name, misspelt or not."""
    file = tmp_path / "shwo"
    file.write_text("no log")
    assert "did you mean" not in run("log", str(file)).stderr
    assert "does not exist" in run("log", "flight_17.jsonl").stderr


def test_what_a_device_refuses_is_not_the_disk_s(capsys: pytest.CaptureFixture[str]) -> None:
    for error, said in (
        (PermissionError(errno.EACCES, "no permission"), "unexpected PermissionError"),
        (PermissionError(errno.EACCES, "no permission", "/x"), "/x cannot be used"),
        (OSError(errno.ENOSPC, "No space left", "/x"), "/x cannot be written"),
    ):
        with pytest.raises(typer.Exit), report_failures():
            raise error
        assert said in capsys.readouterr().err
