"""`perchctl log` as one types it: the newest log, outputs, wrong words."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from tests.helpers import log as synthetic
from tests.helpers.commands import elsewhere, run  # noqa: F401

OLD, NEW = "perchctl-logs/flight_old.jsonl", "perchctl-logs/flight_new.jsonl"


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """Two flights where `fly` puts them, the killed one newer."""
    synthetic.write(tmp_path / OLD, summary=synthetic.SUMMARY, most=60)
    os.utime(tmp_path / OLD, (1000, 1000))
    synthetic.write(tmp_path / NEW, most=30)
    return tmp_path / "perchctl-logs"


@pytest.mark.parametrize("words", [[], ["show"], ["show", "perchctl-logs"]])
def test_the_newest_is_shown_and_named(words: list[str], logs: Path) -> None:
    said = run("log", *words)
    assert (said.code, said.complaint) == (0, f"the newest log: {NEW}")
    assert said.stdout.startswith("UNKNOWN: the log ends in APPROACH")
    assert json.loads(run("log", *words, "--json").stdout)["log"] == NEW


def test_what_never_took_off_was_not_killed_in_the_air(tmp_path: Path) -> None:
    """As where a check before take-off has refused: the log has a header and nothing flown."""
    log = synthetic.write(tmp_path / "flight_refused.jsonl", most=0)
    said = run("log", "show", str(log)).stdout
    assert "UNKNOWN: the log holds no flight" in said
    assert "never took off" in " ".join(said.split())
    assert "positions by deck" in " ".join(said.split())


def test_a_table_goes_beside_the_log_or_to_a_file(logs: Path) -> None:
    said = run("log", "export", OLD)
    assert said.stdout.startswith("export:    perchctl-logs/flight_old.csv (60 rows, ")
    rows = list(csv.reader((logs / "flight_old.csv").read_text().splitlines()))
    assert (rows[0][0], rows[1][0], len(rows)) == ("t_s", "0.0", 61)
    assert run("log", "export", OLD).code == 30
    assert run("log", "export", OLD, "--force").code == 0
    Path("new").mkdir()
    assert "new/x.csv (30 rows" in run("log", "export", "-o", "new/x.csv").stdout


def test_a_report_is_of_the_newest(logs: Path) -> None:
    said = run("log", "report", "-o", "newest.html", "--json")
    assert f"the newest log: {NEW}" in said.stderr
    (told,) = json.loads(said.stdout)["flights"]
    assert told["log"] == NEW


def test_a_plot_s_name_is_its_form(logs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Path] = []
    monkeypatch.setattr("perchctl.analysis.plot_flight", lambda _log, path: drawn.append(path))
    told: list[str] = []
    monkeypatch.setattr("perchctl.commands.log.say_on_terminal", told.append)
    assert run("log", "plot", OLD).stdout == "plot:      perchctl-logs/flight_old.png\n"
    assert told == [f"reading {OLD}", "drawing perchctl-logs/flight_old.png"]
    assert run("log", "plot", OLD, "-o", "x.PDF").stdout == "plot:      x.PDF\n"
    assert drawn == [Path("perchctl-logs/flight_old.png"), Path("x.PDF")]
    Path("perchctl-logs/flight_old.png").touch()  # as `fly` leaves it
    again = run("log", "plot", OLD)
    assert (again.code, again.stdout) == (0, "plot:      perchctl-logs/flight_old.png\n")
    assert "add --force" in again.complaint
    assert len(drawn) == 2
    assert run("log", "plot", OLD, "--force").code == 0
    assert len(drawn) == 3


@pytest.mark.long
@pytest.mark.parametrize("name", ["x.png", "x.pdf", "x.svg"])
def test_the_same_flight_is_drawn_to_the_same_bytes(logs: Path, name: str) -> None:
    """Also where objects lie at other addresses, by which a solver may order its sums."""
    drawn, kept = set[bytes](), list[list[object]]()
    for n in range(4):
        kept.append([object() for _ in range(10_007 * n)])
        assert run("log", "plot", OLD, "-o", name, "--force").code == 0
        drawn.add(Path(name).read_bytes())
    assert len(drawn) == 1


def test_two_flights_are_compared(logs: Path) -> None:
    assert "A and B have the same profile" in run("log", "compare", OLD, NEW).stdout
    assert json.loads(run("log", "compare", OLD, NEW, "--json").stdout)["profile"] == {}


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["show", "none.jsonl"], 20, "does not exist"),
        (["show", "empty"], 20, "contains no flight log"),
        (["replay", "flight_1.jsonl", "-p", "smi"], 20, "'smi'"),
        (["show", "a.csv"], 30, "not a perchctl flight log"),
        (["plot", "bare.jsonl"], 30, "nothing to plot"),
        (["plot", "flight_1.jsonl", "-o", "x.gif"], 30, "must end in"),
        (["export", "bare.jsonl"], 30, "nothing to export"),
        (["show", "damaged.jsonl"], 30, "battery_v is not a number"),
        (["show", "odd.jsonl"], 30, "no flight writes"),
        (["report", "bad.jsonl"], 30, "tel_age_s is not a number"),
        (["export", "bare.jsonl", "-o", "x.mcap"], 30, "must end in .csv"),
        (["report", "bare.jsonl", "-o", "bare.jsonl"], 30, "must end in"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_goes_wrong_is_one_sentence(words: list[str], code: int, said: str) -> None:
    Path("empty").mkdir()
    Path("a.csv").write_text("t_s,phase\n0,x\n")
    synthetic.write(Path("bare.jsonl"), most=0)
    good = synthetic.write(Path("flight_1.jsonl"), most=1, summary=synthetic.SUMMARY).read_bytes()
    Path("odd.jsonl").write_bytes(good.replace(b'"duration_s":18.6', b'"duration_s":"x"'))
    Path("damaged.jsonl").write_bytes(good.replace(b'"battery_v":3.', b'"battery_v":"a","y":3.'))
    lines = synthetic.write(Path("whole.jsonl"), summary=synthetic.SUMMARY, most=200).read_bytes()
    Path("bad.jsonl").write_bytes(lines.replace(b'"tel_age_s":0.', b'"tel_age_s":"q","y":0.'))
    result = run("log", *words)
    assert (result.code, result.stdout) == (code, "")
    assert said in result.complaint
