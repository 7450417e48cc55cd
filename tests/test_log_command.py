"""`perchctl log` as one types it: the newest log, outputs, wrong words."""

from __future__ import annotations

import csv
import json
import os
from io import StringIO
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.commands import complete
from tests.helpers import log as synthetic
from tests.helpers.commands import elsewhere, run  # noqa: F401


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """Two flights where `fly` puts them, the killed one newer."""
    folder = tmp_path / "perchctl-logs"
    old = synthetic.write(folder / "flight_old.jsonl", summary=synthetic.SUMMARY, most=60)
    os.utime(old, (1000, 1000))
    synthetic.write(folder / "flight_new.jsonl", most=30)
    return folder


def test_the_newest_is_shown_and_named(logs: Path) -> None:
    said = run("log", "show")
    assert (said.code, said.complaint) == (0, "the newest log: perchctl-logs/flight_new.jsonl")
    assert said.stdout.startswith("UNKNOWN: the log ends in APPROACH")
    told = json.loads(run("log", "show", "--log-dir", str(logs), "--json").stdout)
    assert told["log"] == str(logs / "flight_new.jsonl")
    Path("mine.yaml").write_text("extends: sim\nlog: {directory: other}\n")
    synthetic.write(Path("other/flight_x.jsonl"), summary=synthetic.SUMMARY, most=3)
    assert run("log", "show", "-p", "mine.yaml").stdout.startswith("PERCHED")


def test_a_folder_is_listed(logs: Path) -> None:
    lines = run("log", "show", "--list").stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["log", "flight_new.jsonl", "flight_old.jsonl"]
    told = json.loads(run("log", "show", "--list", "-n", "1", "--json").stdout)
    assert [each["outcome"] for each in told["logs"]] == ["unknown"]


def test_a_table_goes_to_a_file_or_to_stdout(logs: Path) -> None:
    piped = run("log", "export", "perchctl-logs/flight_old.jsonl", "-o", "-")
    assert piped.code == 0
    rows = list(csv.reader(StringIO(piped.stdout)))
    assert (rows[0][0], rows[1][0], len(rows)) == ("t_s", "0.0", 61)
    said = run("log", "export", "--csv", "perchctl-logs/flight_old.jsonl")
    assert said.stdout.startswith("export:    perchctl-logs/flight_old.csv (60 rows, ")
    assert (logs / "flight_old.csv").read_text() == piped.stdout
    assert run("log", "export", "--csv", "perchctl-logs/flight_old.jsonl").code == 30
    assert run("log", "export", "--csv", "perchctl-logs/flight_old.jsonl", "--force").code == 0
    told = json.loads(run("log", "export", "-o", "new/x.csv", "--json").stdout)
    assert (told["output"], told["format"], told["rows"]) == ("new/x.csv", "csv", 30)


def test_the_recording_of_a_flight_is_not_replaced_by_an_export(logs: Path) -> None:
    """It holds the pictures, and --force does not mean them."""
    own = logs / "flight_old.mcap"
    own.write_bytes(b"pictures")
    old = "perchctl-logs/flight_old.jsonl"
    said = run("log", "export", "--mcap", old, "-o", str(own), "--force")
    assert said.code == 30
    assert "the flight's own recording" in said.complaint
    assert own.read_bytes() == b"pictures"


def test_a_report_is_of_the_newest_and_of_each_log_once(logs: Path) -> None:
    said = run("log", "report", "-o", "newest.html", "--json")
    assert said.complaint == "the newest log: perchctl-logs/flight_new.jsonl"
    (told,) = json.loads(said.stdout)["flights"]
    assert told["log"] == "perchctl-logs/flight_new.jsonl"
    old = "perchctl-logs/flight_old.jsonl"
    said = run("log", "report", old, str(logs / "flight_old.jsonl"), "-o", "old.html", "--json")
    assert len(json.loads(said.stdout)["flights"]) == 1
    assert "named twice" in said.complaint


def test_programs_are_told_what_an_export_lacks(logs: Path) -> None:
    said = run("log", "export", "--mcap", "perchctl-logs/flight_old.jsonl", "--json")
    assert any("without pictures" in note for note in json.loads(said.stdout)["notes"])


def test_a_plot_s_name_is_its_form(logs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Path] = []
    monkeypatch.setattr("perchctl.analysis.plot_flight", lambda _log, path: drawn.append(path))
    old = "perchctl-logs/flight_old.jsonl"
    assert run("log", "plot", old).stdout == "plot:      perchctl-logs/flight_old.png\n"
    assert json.loads(run("log", "plot", old, "-o", "x.PDF", "--json").stdout)["plot"] == "x.PDF"
    assert drawn == [Path("perchctl-logs/flight_old.png"), Path("x.PDF")]
    assert "must end in .png or .pdf or .svg" in run("log", "plot", old, "-o", "x.gif").complaint


@pytest.mark.long
@pytest.mark.parametrize("name", ["x.png", "x.pdf", "x.svg"])
def test_the_same_flight_is_drawn_to_the_same_bytes(logs: Path, name: str) -> None:
    old = "perchctl-logs/flight_old.jsonl"
    assert run("log", "plot", old, "-o", name).code == 0
    once = Path(name).read_bytes()
    assert run("log", "plot", old, "-o", name, "--force").code == 0
    assert Path(name).read_bytes() == once


def test_two_flights_are_compared(logs: Path) -> None:
    names = ("perchctl-logs/flight_old.jsonl", "perchctl-logs/flight_new.jsonl")
    assert "their profiles are the same" in run("log", "compare", *names).stdout
    told = json.loads(run("log", "compare", *names, "--json").stdout)
    assert told["differences"]["turns"] == -30
    assert told["profile"] == {}


BAD: dict[str, dict[str, object]] = {
    "exposure": {"frame_t_s": "x"},
    "timing": {"kind": "turn", "timing": {"pipeline_s": "q"}},
}
"""Records, by what in them no flight writes."""


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["show", "none.jsonl"], 20, "does not exist"),
        (["show", "perchctl-logs"], 20, "is a folder"),
        (["show", "--log-dir", "nowhere"], 20, "the folder nowhere cannot be read"),
        (["show", "--log-dir", "empty"], 20, "holds no flight log"),
        (["show", "-p", "smi"], 20, "'smi'"),
        (["show", "a.csv"], 30, "not a flight log"),
        (["show", "a.jsonl", "--list"], 2, "--list is of a folder"),
        (["show", "-n", "3"], 2, "--count is of --list"),
        (["show", "a.jsonl", "--log-dir", "x"], 2, "leave out one of them"),
        (["show", "-p", "sim", "--log-dir", "x"], 2, "leave out one"),
        (["plot", "a.csv"], 30, "not a flight log"),
        (["plot", "bare.jsonl"], 30, "nothing to plot"),
        (["export", "bare.jsonl", "--csv"], 30, "nothing to export"),
        (["export", "damaged.jsonl", "--csv"], 30, "battery_v: a number is needed"),
        (["show", "damaged.jsonl"], 30, "battery_v is not a number"),
        (["show", "odd.jsonl"], 30, "no flight writes"),
        *((["report", f"bad_{name}.jsonl"], 30, "a value that no flight writes") for name in BAD),
        (["export", "bare.jsonl"], 2, "say in which form"),
        (["export", "bare.jsonl", "-o", "x.txt"], 2, "say in which form"),
        (["export", "--csv", "--mcap", "bare.jsonl"], 2, "one at a time"),
        (["export", "--csv", "bare.jsonl", "-o", "x.mcap"], 30, "must end in .csv"),
        (["export", "--mcap", "bare.jsonl", "-o", "-"], 2, "CSV on stdout"),
        (["export", "bare.jsonl", "-o", "-", "--json"], 2, "CSV on stdout"),
        (["compare", "a.csv", "bare.jsonl"], 30, "not a flight log"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_goes_wrong_is_one_sentence(
    words: list[str], code: int, said: str, logs: Path
) -> None:
    Path("empty").mkdir()
    Path("a.csv").write_text("t_s,phase\n0,x\n")
    synthetic.write(Path("bare.jsonl"), most=0)
    good = synthetic.write(Path("damaged.jsonl"), most=1, summary=synthetic.SUMMARY).read_bytes()
    Path("odd.jsonl").write_bytes(good.replace(b'"duration_s":18.6', b'"duration_s":"x"'))
    Path("damaged.jsonl").write_bytes(good.replace(b'"battery_v":3.', b'"battery_v":"a","y":3.'))
    lines = synthetic.write(Path("whole.jsonl"), summary=synthetic.SUMMARY, most=200).read_bytes()
    *before, tick, end = lines.splitlines(keepends=True)
    for name, bad in BAD.items():
        changed = json.dumps(json.loads(tick) | bad).encode() + b"\n"
        Path(f"bad_{name}.jsonl").write_bytes(b"".join([*before, tick, changed, end]))
    result = run("log", *words)
    assert result.code == code
    assert said in result.complaint
    if "--json" not in words:
        assert result.stdout == ""
        told = json.loads(run("log", *words, "--json").stdout)
        assert told["exit_code"] == code


def test_help_is_whole_at_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    whole = run("log")
    assert (whole.code, whole.stdout) == (0, run("log", "--help").stdout)
    for command in ("show", "plot", "compare", "export", "replay", "report"):
        assert f"\n  {command} " in whole.stdout
        text = run("log", command, "-h").stdout
        assert max(map(len, text.splitlines())) <= 80
    assert run("log", "shwo").code == 2


def test_tab_offers_logs(logs: Path) -> None:
    assert complete.logs("perchctl-logs/flight_o") == ["perchctl-logs/flight_old.jsonl"]
