"""What the tests of `perchctl calibrate` share."""

from __future__ import annotations

from typer.testing import CliRunner, Result

from perchctl.commands import app


def calibrate(*words: str) -> Result:
    return CliRunner().invoke(app, ["calibrate", *map(str, words)])


def refused(result: Result, code: int) -> str:
    """The one sentence of a refusal."""
    assert result.exit_code == code, result.output
    lines = [line for line in result.stderr.splitlines() if not line.endswith("of the board")]
    assert len(lines) == 1, result.stderr
    assert not result.stdout
    return lines[0]
