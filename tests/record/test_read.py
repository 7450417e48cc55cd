"""Reading a log back: cut, killed, damaged; and what is none."""

from __future__ import annotations

import gzip
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from perchctl import __version__
from perchctl.errors import InvalidValue
from perchctl.record import read_log
from perchctl.record.exact import json_line
from tests.helpers import log as synthetic
from tests.helpers.commands import run_apart
from tests.helpers.log import small_log


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
    assert (len(log.records), log.ignored_bytes, log.truncated) == (5, 4096, True)


def test_a_killed_writer_leaves_a_readable_log(tmp_path: Path) -> None:
    """A process that dies without a word, in the middle of its flight."""
    path = tmp_path / "f.jsonl"
    code = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from perchctl.record import LogWatcher\n"
        "from tests.helpers import log as synthetic\n"
        "w = LogWatcher.open(Path(sys.argv[1]), synthetic.header(), live=True)\n"
        "for n, record in enumerate(synthetic.ticks()):\n"
        "    w.write(record)\n"
        "    while n == 150 and Path(sys.argv[1]).read_bytes().count(b'\\n') < 152: pass\n"
        "    if n == 150: os.kill(os.getpid(), 9)\n"
    )
    assert run_apart(str(path), before=code).code == -signal.SIGKILL
    log = read_log(path)
    assert len(log.records) == 151
    assert log.truncated


def test_a_packed_log_is_read_like_another(tmp_path: Path) -> None:
    good = small_log(tmp_path / "good.jsonl")
    path = tmp_path / "x.jsonl.gz"
    path.write_bytes(gzip.compress(good.read_bytes()))
    assert read_log(path).records == read_log(good).records


def with_line(at: int, line: bytes) -> Callable[[bytes], bytes]:
    """Of a good log, with another line in the place of one, and good ones behind it."""

    def damaged(good: bytes) -> bytes:
        lines = good.splitlines(keepends=True)
        return b"".join([*lines[: at - 1], line + b"\n", *lines[at:]])

    return damaged


NO_LOG = "line 1: not a perchctl flight log"
DAMAGED: dict[str, tuple[Callable[[bytes], bytes] | bytes, tuple[str, ...]]] = {
    "empty": (b"", (NO_LOG, "logs are the .jsonl files")),
    "picture": (b"\x89PNG\r\n\x1a\n" + bytes(50), (NO_LOG, "it is a picture")),
    "table": (b"t_s,phase\n0.0,SEARCH\n", (NO_LOG,)),
    "no header": (b'{"kind":"tick","t_s":0.0}\n', (NO_LOG,)),
    "list": (b"[1]\n", (NO_LOG,)),
    "torn gzip": (b"\x1f\x8b\x08\x00" + b"\xff" * 50, (NO_LOG,)),
    "packed other": (gzip.compress(b"\x00\x01" * 900, mtime=0), (NO_LOG,)),
    "cut header": (lambda good: good[:700], (NO_LOG, "truncated in its header")),
    "newer": (
        lambda good: good.replace(b'"version":5', b'"version":9').replace(
            __version__.encode(), b"9.1", 1
        ),
        ("schema version 9, but this perchctl reads 1 to 5", "perchctl 9.1", "update perchctl"),
    ),
    "garbage": (with_line(4, b"garbage"), ("line 4: not a record", "use the original")),
    "no time": (with_line(4, b'{"kind":"tick"}'), ("line 4", "t_s must be")),
    "endless": (with_line(4, b'{"kind":"tick","t_s":1e999}'), ("line 4", "t_s must be")),
    "nested": (with_line(4, b"[" * 100_000), ("line 4", "nested too deep")),
    "kind": (with_line(3, b'{"kind":"?","t_s":1}'), ("line 3", "allowed are")),
}


def test_an_older_log_s_variance_is_the_velocity_s(tmp_path: Path) -> None:
    """Up to version 4 it stood under the position's name."""

    def variances(version: int) -> tuple[float | None, ...]:
        path = tmp_path / f"{version}.jsonl"
        header = synthetic.header() | {"kind": "header", "version": version}
        turn = {"kind": "turn", "t_s": 1.0, "taken": {"late": [{"position_variance_m2": 3e-4}]}}
        tick = {"kind": "tick", "t_s": 1.0, "var_m2": 3e-4, "pos_var_m2": 0.1}
        path.write_bytes(b"".join(map(json_line, (header, turn, tick))))
        log = read_log(path)
        (sample,), (record,) = log.turn_records[0]["taken"]["late"], log.records
        return (
            sample.get("velocity_variance_m2ps2"),
            sample.get("position_variance_m2"),
            record["vel_var_m2ps2"],
        )

    assert variances(4) == (3e-4, None, 3e-4)
    assert variances(5) == (None, 3e-4, None)


@pytest.mark.parametrize("kind", DAMAGED)
def test_what_is_damaged_or_no_log_is_one_sentence(kind: str, tmp_path: Path) -> None:
    content, words = DAMAGED[kind]
    path = tmp_path / "x.jsonl"
    good = small_log(tmp_path / "f.jsonl").read_bytes()
    path.write_bytes(content if isinstance(content, bytes) else content(good))
    with pytest.raises(InvalidValue) as refused:
        read_log(path)
    said = str(refused.value)
    assert said.startswith(str(path))
    assert "\n" not in said
    for word in words:
        assert word in said


def test_what_is_no_text_is_not_read_whole() -> None:
    """It would never end."""
    with pytest.raises(InvalidValue, match="not a perchctl flight log"):
        read_log("/dev/zero")
