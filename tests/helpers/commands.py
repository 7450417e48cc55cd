"""The command line as tests run it: in this process, or in one of its own on pipes."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from perchctl.commands import app
from tests.helpers.flights import ROOT

ON_THE_WAY = (
    "perchctl: connecting", "perchctl: check: ", "perchctl: calibration: ", "perchctl: wrote ",
    "Press Ctrl-C to land. ",
)  # fmt: skip


@dataclass(frozen=True)
class Said:
    code: int
    stdout: str
    stderr: str

    @property
    def complaint(self) -> str:
        """The one sentence on stderr, beside what is said on the way."""
        lines = [s for s in self.stderr.splitlines() if not s.startswith(ON_THE_WAY)]
        assert len(lines) == 1, self.stderr
        assert lines[0].startswith("perchctl: ")
        return lines[0].removeprefix("perchctl: ")


def run(*arguments: str) -> Said:
    """The application in this process, at 80 columns."""
    result = CliRunner().invoke(app, arguments, env={"COLUMNS": "80"})
    assert "Traceback" not in result.output
    return Said(result.exit_code, result.stdout, result.stderr)


def run_apart(
    *arguments: str,
    before: str = "",
    stdout: Any = subprocess.PIPE,
    timeout_s: float = 60.0,
    **environment: str,
) -> Said:
    """The console script in a process of its own, on pipes, without a terminal; `before` is
    Python that is run first."""
    clean = {k: v for k, v in os.environ.items() if k not in ("CFLIB_URI", "NO_COLOR")}
    main = "import sys; sys.argv[0] = 'perchctl'\nfrom perchctl.__main__ import main"
    done = subprocess.run(
        [sys.executable, "-c", f"{before}\n{main}\nsys.exit(main())", *arguments],
        env=clean | {"PYTHONPATH": str(ROOT)} | environment,
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        timeout=timeout_s,
    )
    assert "Traceback" not in done.stderr
    return Said(done.returncode, done.stdout or "", done.stderr)


@pytest.fixture(autouse=True)
def elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Logs and the table cache stay out of the user's folders."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CFLIB_URI", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
