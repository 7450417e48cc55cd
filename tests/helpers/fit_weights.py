"""What the tests of `perchctl fit-weights` share."""

from __future__ import annotations

from typer.testing import CliRunner, Result

from perchctl.commands import app


def run(*words: object, stdin: str | None = None) -> Result:
    result = CliRunner().invoke(app, ["fit-weights", *map(str, words)], input=stdin)
    assert "Traceback" not in result.output
    return result
