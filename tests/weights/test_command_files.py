"""`perchctl fit-weights`: bad files are named by line, odd ones are read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from perchctl.weights.data import read_csv
from tests.helpers.fit_weights import BAD, run
from tests.helpers.weights_data import independent, known, write


def test_the_same_rows_twice_are_refused(session: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.csv"
    text = session.read_text()
    header, rows = text.split("\n", 1)
    for arguments, content, said in (
        ((session, session), text, "line 2: this row stands in line 2 of"),
        ((session, copy), text, "line 2: this row stands in line 2 of"),
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
