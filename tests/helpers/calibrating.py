"""Calls of `perchctl calibrate`, and their refusals."""

from __future__ import annotations

from typer.testing import CliRunner, Result

from perchctl.commands import app


def calibrate(*words: object) -> Result:
    return CliRunner().invoke(app, ["calibrate", *map(str, words)])


def refused(result: Result, code: int, *expected: str) -> str:
    """The one sentence of a refusal (behind the usage, where that is wrong), which holds the
    expected words; nothing is on stdout."""
    assert result.exit_code == code, result.output
    lines = [line for line in result.stderr.splitlines() if not line.endswith("of the board")]
    assert len(lines) == 1 or lines[0].startswith("Usage"), result.stderr
    assert not result.stdout
    for words in expected:
        assert words in result.stderr
    return lines[-1]
