"""`perchctl fit-weights`: data in, weights out, bad files named, and the flight that uses them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from perchctl.commands import app
from perchctl.errors import InvalidValue
from perchctl.profile import load_profile
from perchctl.weights.data import NEEDED, read_data
from tests.helpers.weights_data import BEST, independent, known, run, write


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return write(independent(1), tmp_path / "session.csv")


def test_one_object_with_both_methods_and_the_known_weights(tmp_path: Path) -> None:
    other = write(independent(2), tmp_path / "other.csv")
    done = run(write(known(2), tmp_path / "k.csv"), "--json", "--test", other)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    for errors in (found["errors"], found["test"]["errors"]):
        assert set(errors) == {"large", "small", "paper", "lms", "closed_form"}
        assert set(errors["lms"]) == {"x", "y", "z", "yaw", "half_width"}
    assert found["recommended"] == found["closed_form"]
    assert found["data"]["positions"] == 10
    assert found["weights_file"] is None
    for axis, best in zip(("x", "y", "z", "yaw"), BEST, strict=True):
        assert found["closed_form"][axis] == pytest.approx(best, abs=0.005)
        assert found["lms"][axis] == pytest.approx(found["closed_form"][axis], abs=0.01)


def test_weights_go_to_a_file_and_from_there_into_a_flight(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "w.yaml"
    assert run(session, "-o", out).exit_code == 0
    closed = out.read_text()
    refused = run(session, "-o", out, "--method", "lms")
    assert (refused.exit_code, refused.stdout) == (30, "")
    assert "w.yaml already exists; add --force" in refused.stderr
    assert run(session, "-o", out, "--method", "lms", "--force").exit_code == 0
    assert out.read_text() != closed
    assert run(session, "-o", session).exit_code == 2
    (tmp_path / "mine.yaml").write_text(
        "extends: paper\nmerge: {method: weights, weights_file: w.yaml}\n", encoding="utf-8"
    )
    again = yaml.safe_load(out.read_text())
    profile = load_profile(str(tmp_path / "mine.yaml"))
    assert profile.merge.weights.model_dump() == pytest.approx(again["weights"])
    plan = CliRunner().invoke(app, ["fly", "-p", str(tmp_path / "mine.yaml"), "--dry-run"])
    assert "w.yaml" in plan.stdout


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("weights: {x: 2, y: 0, z: 0, yaw: 0}", "weights.x"),
        ("weights: {x: 0.5, y: 0, z: 0}", "weights.yaw is missing"),
        ("weights: 0.5", "weights.x is missing"),
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
    shown = run(data)
    assert "no file written" in shown.stderr
    assert shown.stdout.split("\n\n")[1].startswith("not recommended")
    refused = run(data, "-o", tmp_path / "w.yaml", "--json")
    found = json.loads(refused.stdout)
    assert refused.exit_code == found["exit_code"] == 1
    assert "not written" in refused.stderr
    assert "not written" in found["error"]
    assert found["recommended"] is None
    assert not (tmp_path / "w.yaml").exists()
    assert run(data, "-o", tmp_path / "w.yaml", "--anyway").exit_code == 0


# --- files that will not do ------------------------------------------------------------------


Edit = Callable[[list[str]], str]


def cell_of(row: list[str], name: str) -> float:
    return float(row[NEEDED.index(name)])


BAD: list[tuple[str, slice, Edit, str]] = [
    # The column, its rows, their new text, and what is said of it; row 0 is the header.
    ("small_z_m", slice(0, 1), lambda r: "other", "line 1: column small_z_m is missing"),
    ("actual_x_m", slice(1, None), lambda r: str(100 * cell_of(r, "actual_x_m")), "in x"),
    ("actual_z_m", slice(121, 141), lambda r: str(100 * cell_of(r, "actual_z_m")), "position 7"),
    ("small_z_m", slice(1, None), lambda r: str(1000 * cell_of(r, "small_z_m")), "small and"),
    (
        "actual_yaw_rad",
        slice(1, None),
        lambda r: str(math.degrees(cell_of(r, "actual_yaw_rad"))),
        "like degrees",
    ),
    ("position", slice(1, None), lambda r: "1", "1 positions show both markers"),
    ("large_x_m", slice(8, 9), lambda r: "1e999", "line 9: the large pose contains an inf"),
    ("large_x_m", slice(99, 100), lambda r: "abc", "line 100: could not convert"),
    (
        "small_y_m",
        slice(49, 50),
        lambda r: "",
        "line 50: only some cells of the small pose are",
    ),
    (
        "actual_z_m",
        slice(50, 51),
        lambda r: "",
        "line 51: only some cells of the actual pose are",
    ),
    ("large_z_m", slice(1, None), lambda r: r[8], "constant in z"),
    ("small_yaw_rad", slice(5, 6), lambda r: "0.1,0.2", "line 6: 15 cells, but the header has 14"),
    ("position", slice(7, 8), lambda r: "1.5", "line 8: position must be a whole number"),
]


@pytest.mark.parametrize(("column", "rows", "edit", "said"), BAD, ids=[case[-1] for case in BAD])
def test_bad_input_is_one_sentence(
    column: str, rows: slice, edit: Edit, said: str, tmp_path: Path
) -> None:
    path = write(independent(5, per=20), tmp_path / "bad.csv")
    table = [line.split(",") for line in path.read_text().splitlines()]
    for row in table[rows]:
        row[NEEDED.index(column)] = edit(row)
    path.write_text("".join(",".join(row) + "\n" for row in table), encoding="utf-8")
    done = run(path)
    assert done.exit_code == 30
    assert done.stderr.count("\n") == 1
    assert str(path) in done.stderr
    assert said in done.stderr


def test_a_marker_that_is_never_seen_and_a_file_that_is_cut_are_named(tmp_path: Path) -> None:
    data = independent(5, per=20)
    path = write(data, tmp_path / "bad.csv")
    path.write_bytes(path.read_bytes()[:10_000])
    lines = path.read_text().count("\n")
    assert f"line {lines + 1}: " in run(path).stderr
    text = write(data, path).read_text().splitlines()
    blind = [",".join([*(c := row.split(","))[:6], *[""] * 4, *c[10:]]) for row in text[1:]]
    path.write_text("\n".join([text[0], *blind, ""]))
    assert "the small marker was never seen" in run(path).stderr


def test_other_columns_orders_blanks_and_quotes_are_read(tmp_path: Path) -> None:
    plain = write(known(4, per=20), tmp_path / "a.csv")
    rows = [line.split(",") for line in plain.read_text().splitlines()]
    odd = "\ufeff" + "\r\n".join(
        ",".join(['"' + row[0] + '"', "note", *(f" {c}" for c in row[:0:-1])]) for row in rows
    )
    text = odd.replace("\r\n", "\r\n\r\n", 1)
    (tmp_path / "b.csv").write_text(text, encoding="utf-8", newline="")
    one, two = (read_data(tmp_path / name) for name in ("a.csv", "b.csv"))
    assert np.array_equal(one.large, two.large)
    assert np.array_equal(one.actual, two.actual)


def test_no_data_no_file_and_a_test_by_the_data_itself(session: Path, tmp_path: Path) -> None:
    assert run().exit_code == 2
    assert run(tmp_path / "none.csv").exit_code == 20
    assert run(session, "--test", session).exit_code == 30
    assert run("x.csv", "--method", "magic").exit_code == 30
