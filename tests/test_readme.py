"""The README holds: its command lines run, its tables are the code's."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from perchctl.calibration.files import load_calibration
from perchctl.errors import EXIT_CODES
from perchctl.mission.diagram import diagram, rows_table
from tests.helpers.boards import CHARUCO, render_folder
from tests.helpers.recording import make_recording

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CAMCHAIN = """cam0:
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: [-0.2, 0.05, 0.001, -0.002]
  intrinsics: [400.5, 401.5, 320.25, 240.75]
  resolution: [640, 480]
"""


def _command_lines() -> list[str]:
    """Every perchctl command: in indented blocks, and the last link of the fenced chains."""
    lines = [line.strip() for line in re.findall(r"^ {4,}perchctl .*$", README, re.MULTILINE)]
    for block in re.findall(r"^```sh\n(.*?)^```", README, re.MULTILINE | re.DOTALL):
        for chain in block.splitlines():
            lines += [part.strip() for part in chain.split("&&") if "perchctl " in part]
    return sorted({line for line in lines if line.startswith("perchctl ")})


def _cheap(line: str) -> list[str]:
    """The same command, kept from arming anything and from flying for minutes."""
    words = shlex.split(line)[1:]
    if words[0] == "fly" and "--dry-run" not in words:
        words.append("--dry-run")
    if words[0] == "simulate" and "-n" in words:
        words[words.index("-n") + 1] = "1"
    if words[0] == "fit-weights" and "--collect" in words:
        words += ["--positions", "3", "--frames", "10"]
    if words[0] == "track":  # without a camera
        words = ["video:flight.mp4" if word == "camera:0" else word for word in words]
    return words


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the commands name: pictures, a video and its calibration."""
    folder = tmp_path_factory.mktemp("recording")
    make_recording(folder)
    render_folder(folder / "board", load_calibration(folder / "camera.yaml"), CHARUCO, 8, seed=1)
    (folder / "camchain.yaml").write_text(CAMCHAIN, encoding="utf-8")
    return folder


def test_there_are_commands_to_run() -> None:
    assert len(_command_lines()) >= 4


@pytest.mark.parametrize("line", _command_lines())
def test_every_command_line_runs(line: str, tmp_path: Path, recording: Path) -> None:
    shutil.copytree(recording, tmp_path, dirs_exist_ok=True)
    before = set(tmp_path.iterdir())
    text = (ROOT / "profiles" / "crazyflie.yaml").read_text(encoding="utf-8")
    (tmp_path / "my_vehicle.yaml").write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "perchctl", *_cheap(line)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (
        done.stdout.strip()
        or "http://127.0.0.1:" in done.stderr
        or set(tmp_path.iterdir()) > (before | {tmp_path / "my_vehicle.yaml"})
    )


def test_the_diagram_is_the_table() -> None:
    assert f"```mermaid\n{diagram()}\n```" in README
    assert rows_table() in README


def test_the_exit_codes_are_the_code_s() -> None:
    for code, meaning in EXIT_CODES.items():
        assert f"| {code} | {meaning} |" in README


def test_set_up_is_two_commands() -> None:
    blocks = re.findall(r"^```sh\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    assert [len(block.strip().splitlines()) for block in blocks] == [1, 1]
    assert blocks[0].strip().endswith("perchctl fly")
    assert blocks[1].strip().endswith("pytest")


def test_every_shipped_profile_is_described() -> None:
    for path in (ROOT / "profiles").glob("*.yaml"):
        assert f"| `{path.stem}` |" in README
