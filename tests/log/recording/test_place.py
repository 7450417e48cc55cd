"""A recording lies beside its log, whatever the log's name."""

from __future__ import annotations

from pathlib import Path

import pytest

from perchctl.log import recording_path


@pytest.mark.parametrize("name", ["x.jsonl", "x.jsonl.gz", "x.mcap"])
@pytest.mark.parametrize("kind", [str, Path])
def test_it_is_found_by_the_log_the_packed_log_and_itself(name: str, kind: type) -> None:
    assert recording_path(kind(Path("logs.d") / name)) == Path("logs.d") / "x.mcap"
