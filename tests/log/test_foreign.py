"""A file that is no flight log is named for what it is, and nothing is read for long."""

from __future__ import annotations

import gzip
import tracemalloc
from pathlib import Path

import pytest

from perchctl.errors import InvalidValue, NotFound
from perchctl.log import read, read_log
from tests.helpers import log as synthetic
from tests.helpers.commands import run


@pytest.fixture
def good(tmp_path: Path) -> bytes:
    return synthetic.write(tmp_path / "good.jsonl", most=20).read_bytes()


def refusal(path: Path, content: bytes) -> str:
    path.write_bytes(content)
    with pytest.raises(InvalidValue) as refused:
        read_log(path)
    said = str(refused.value)
    assert said.startswith(str(path))
    assert "\n" not in said
    return said


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"", "the file is empty"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), "a PNG picture"),
        (b"\xff\xd8\xff\xe0" + bytes(50), "a JPEG picture"),
        (b"\x89MCAP0\r\n", "an MCAP recording"),
        (b"PAR1" + bytes(50), "a Parquet table"),
        (b"\x00\x00\x00\x20ftypisom", "a video"),
        (bytes(range(256)) * 4, "a binary file"),
        (b"t_s,phase\n0.0,SEARCH\n", "a table"),
        (b"hello\n", "some other text"),
        (b'{"part":"carry"}\n', "some other JSON"),
        (b'{"kind":"tick","t_s":0.0}\n', "its header is missing"),
        (b"\n\n", "its first line is empty"),
        (b"\x1f\x8b\x08\x00" + b"\xff" * 50, "packed by gzip, and its begin is damaged"),
        (gzip.compress(b"\x00\x01" * 900), "a binary file"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_it_is(content: bytes, named: str, tmp_path: Path) -> None:
    assert named in refusal(tmp_path / "x.jsonl", content)


@pytest.mark.parametrize("begin", [b"{", b""])
def test_what_unfolds_without_bound_is_read_up_to_a_limit(
    begin: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "bomb.jsonl.gz"
    path.write_bytes(gzip.compress(begin + bytes(40_000_000)))
    monkeypatch.setattr(read, "MOST_LOG_BYTES", 1_000_000)
    tracemalloc.start()
    try:
        with pytest.raises(InvalidValue, match="more than 1 MB" if begin else "binary"):
            read_log(path)
        assert tracemalloc.get_traced_memory()[1] < 6_000_000
    finally:
        tracemalloc.stop()
    assert run("log", "show", str(path)).code == InvalidValue.exit_code


def test_a_log_has_a_largest_size_unpacked_or_not(
    good: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(read, "MOST_LOG_BYTES", len(good))
    path = tmp_path / "x.jsonl"
    for packed in (bytes, gzip.compress):
        path.write_bytes(packed(good))
        assert not read_log(path).ignored_bytes
        assert "more than" in refusal(path, packed(good + b"{}\n"))


def test_a_header_that_is_cut_off(good: bytes, tmp_path: Path) -> None:
    said = refusal(tmp_path / "x.jsonl", good[:700])
    assert "cut off in its header, after 700 bytes: take the original" in said


def test_another_version_names_both(good: bytes, tmp_path: Path) -> None:
    newer = good.replace(b'"version":4', b'"version":9').replace(
        b'"perchctl":"0.2.0"', b'"perchctl":"9.1"'
    )
    said = refusal(tmp_path / "x.jsonl", newer)
    assert "schema version 9, this perchctl reads 1 to 4" in said
    assert "written by perchctl 9.1, this is" in said
    assert said.endswith("update perchctl")
    older = good.replace(b'"version":4', b'"version":0')
    assert "update" not in refusal(tmp_path / "x.jsonl", older)


def test_the_log_beside_its_plot_is_named(tmp_path: Path) -> None:
    log = synthetic.write(tmp_path / "f.jsonl", most=2)
    said = refusal(tmp_path / "f.png", b"\x89PNG\r\n\x1a\n")
    assert f"its flight's log is {log}" in said


def test_what_is_no_text_is_not_read_whole() -> None:
    """It would never end."""
    with pytest.raises(InvalidValue, match="a binary file"):
        read_log("/dev/zero")


def test_a_folder_and_nothing(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="is a folder"):
        read_log(tmp_path)
    with pytest.raises(NotFound, match="does not exist"):
        read_log(tmp_path / "none.jsonl")
