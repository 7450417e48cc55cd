"""Reading a log back: cut, killed, damaged; and what is none."""

from __future__ import annotations

import gzip
import json
import signal
from pathlib import Path

import numpy as np
import pytest

from perchctl.errors import InvalidValue, NotFound
from perchctl.record import read_log
from tests.helpers import log as synthetic
from tests.helpers.log import run_python, small_log


def test_any_cut_of_the_file_is_readable_behind_its_header(tmp_path: Path) -> None:
    data = small_log(tmp_path / "f.jsonl").read_bytes()
    header = data.index(b"\n") + 1
    cut = tmp_path / "cut.jsonl"
    for length in range(header, len(data) - 1):
        cut.write_bytes(data[:length])
        log = read_log(cut)
        assert log.truncated
        whole = data[:length].rfind(b"\n") + 1
        # A last line that lacks only its newline is whole.
        assert log.ignored_bytes in (length - whole, 0)
        kept = len(log.records) + len(log.events) + (log.summary is not None)
        assert kept == data[:whole].count(b"\n") - 1 + (length > whole and log.ignored_bytes == 0)


def test_zeros_after_a_power_cut_are_ignored(tmp_path: Path) -> None:
    path = small_log(tmp_path / "f.jsonl")
    path.write_bytes(path.read_bytes() + b"\0" * 4096)
    log = read_log(path)
    assert len(log.records) == 5
    assert log.ignored_bytes == 4096
    assert log.truncated


def test_a_killed_writer_leaves_a_readable_log(tmp_path: Path) -> None:
    """A process that dies without a word, in the middle of its flight."""
    path = tmp_path / "f.jsonl"
    code = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from perchctl.record.write import FlightLogWriter\n"
        "from tests.helpers import log as synthetic\n"
        "from tests.helpers.mission import note\n"
        "w = FlightLogWriter.open(Path(sys.argv[1]), synthetic.header(), live=True)\n"
        "for n, record in enumerate(synthetic.ticks()):\n"
        "    w.write(record)\n"
        "    while n == 150 and Path(sys.argv[1]).read_bytes().count(b'\\n') < 152: pass\n"
        "    if n == 150: os.kill(os.getpid(), 9)\n"
    )
    done = run_python(code, path)
    assert done.returncode == -signal.SIGKILL
    log = read_log(path)
    assert len(log.records) == 151
    assert log.truncated


def test_not_a_flight_log(tmp_path: Path) -> None:
    def refused(content: bytes, match: str) -> None:
        path = tmp_path / "x.jsonl"
        path.write_bytes(content)
        with pytest.raises(InvalidValue, match=match):
            read_log(path)

    good = small_log(tmp_path / "f.jsonl").read_bytes().splitlines(keepends=True)
    refused(b'{"kind":"header"}\n', "line 1: not a flight log")
    refused(b"[1]\n", "line 1: not a flight log")
    refused(b"".join([*good[:3], b"garbage\n", *good[3:]]), "line 4: not a record")
    refused(b"".join([*good[:3], b'{"kind":"tick"}\n', *good[3:]]), "line 4: .*t_s must be")
    refused(b"".join([*good[:2], b'{"kind":"?","t_s":1}\n', *good[3:]]), "line 3: .*allowed are")
    refused(b"".join([*good[:2], b'{"kind":"tick","t_s":NaN}\n', *good[3:]]), "line 3: .*NaN")
    refused(b"".join([*good[:2], b"[" * 100_000 + b"\n", *good[3:]]), "line 3")


def test_columns(tmp_path: Path) -> None:
    log = read_log(small_log(tmp_path / "f.jsonl"))
    np.testing.assert_allclose(log.column("z_m"), [0.0, 0.1, 0.2, 0.3, 0.4])
    assert np.isnan(log.column("ex_m")).all()
    with pytest.raises(InvalidValue, match="phase is not a number"):
        log.column("phase")
    assert json.dumps(log.header)  # plain values only


# --- a file that is no log ----------------------------------------------------------------------


def refusal(path: Path, content: bytes) -> str:
    path.write_bytes(content)
    with pytest.raises(InvalidValue) as refused:
        read_log(path)
    said = str(refused.value)
    assert said.startswith(str(path))
    assert "\n" not in said
    return said


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n\n",
        b"\x89PNG\r\n\x1a\n" + bytes(50),
        b"t_s,phase\n0.0,SEARCH\n",
        b'{"part":"carry"}\n',
        b'{"kind":"tick","t_s":0.0}\n',
        b"\x1f\x8b\x08\x00" + b"\xff" * 50,
        gzip.compress(b"\x00\x01" * 900, mtime=0),
    ],
)
def test_what_is_no_log_is_refused(content: bytes, tmp_path: Path) -> None:
    said = refusal(tmp_path / "x.csv", content)
    assert "logs are the .jsonl files" in said
    assert ("it is a picture" if content.startswith(b"\x89PNG") else "not a flight log") in said
    log = synthetic.write(tmp_path / "x.jsonl", most=2)
    assert "cut off in its header" in refusal(log, log.read_bytes()[:700])


def test_a_packed_log_is_read_like_another(tmp_path: Path) -> None:
    good = synthetic.write(tmp_path / "good.jsonl", most=20).read_bytes()
    path = tmp_path / "x.jsonl.gz"
    path.write_bytes(gzip.compress(good))
    assert read_log(path).records == read_log(tmp_path / "good.jsonl").records


def test_another_version_names_both(tmp_path: Path) -> None:
    good = synthetic.write(tmp_path / "good.jsonl", most=20).read_bytes()
    newer = good.replace(b'"version":4', b'"version":9').replace(
        b'"perchctl":"0.2.0"', b'"perchctl":"9.1"'
    )
    said = refusal(tmp_path / "x.jsonl", newer)
    assert "schema version 9, this perchctl reads 1 to 4" in said
    assert "written by perchctl 9.1, this is" in said
    assert said.endswith("update perchctl")
    older = good.replace(b'"version":4', b'"version":0')
    assert "update" not in refusal(tmp_path / "x.jsonl", older)


def test_what_is_no_text_is_not_read_whole() -> None:
    """It would never end."""
    with pytest.raises(InvalidValue, match="not a flight log"):
        read_log("/dev/zero")


def test_a_folder_and_nothing(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="is a folder"):
        read_log(tmp_path)
    with pytest.raises(NotFound, match="does not exist"):
        read_log(tmp_path / "none.jsonl")
