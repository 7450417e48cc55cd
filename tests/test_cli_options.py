"""Options that would not be heeded are refused, and notes on the profile are told once."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.commands.command_line import reported
from perchctl.errors import InvalidValue, ProfileNote
from tests.helpers.commands import elsewhere, run, run_apart  # noqa: F401


def test_a_note_on_the_profile_is_one_sentence_once(capsys: pytest.CaptureFixture[str]) -> None:
    """Other warnings are left to those who show them: here to pytest, else to Python."""

    def warn() -> None:
        with reported():
            for key in ("a", "b", "a"):
                warnings.warn(f"mine.yaml: {key} has another name", ProfileNote, stacklevel=1)
            warnings.warn("something else", DeprecationWarning, stacklevel=1)

    with pytest.warns(DeprecationWarning, match="something else") as others:
        warn()
    assert len(others) == 1
    assert capsys.readouterr().err == (
        "perchctl: mine.yaml: a has another name\nperchctl: mine.yaml: b has another name\n"
    )
    with pytest.raises(ProfileNote):
        warnings.warn("an error again behind it", ProfileNote, stacklevel=1)


def test_a_note_stands_before_the_sentence_of_a_failure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def load(name: str) -> None:
        warnings.warn(f"{name}: camera.old is camera.new by now", ProfileNote, stacklevel=1)
        raise InvalidValue(f"{name}: no good")

    monkeypatch.setattr("perchctl.commands.fly.load_profile", load)
    said = run("fly", "-p", "mine.yaml", "--dry-run")
    assert said.code == 30
    assert said.stderr.splitlines() == [
        "perchctl: mine.yaml: camera.old is camera.new by now",
        "perchctl: mine.yaml: no good",
    ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--only 3 -n 5", ["--only 3", "-n 5 does not apply", "leave it out"]),
        ("--only 3 --seed 7", ["--seed 7 does not apply"]),
        ("--only 3 --jobs 2 --seed 0", ["--seed 0 and --jobs 2 do not apply", "leave them out"]),
        ("--faults list --log-dir x", ["flies nothing", "--log-dir x does not apply"]),
        ("--only 3 --out x.jsonl", ["--out x.jsonl does not apply"]),
        ("--resume", ["--resume", "--out"]),
        ("--keep failed", ["--keep", "--log-dir"]),
        ("--keep best --log-dir x", ["--keep best", "all and failed"]),
    ],
)
def test_options_that_do_not_apply_are_refused(arguments: str, words: list[str]) -> None:
    said = run("simulate", *arguments.split())
    assert said.code == 2
    for word in words:
        assert word in said.complaint
    assert list(Path().iterdir()) == []


def test_calibrate_refuses_a_page_without_a_live_camera() -> None:
    Path("pictures").mkdir()
    said = run("calibrate", "pictures", "--view")
    assert said.code == 2
    for word in ("pictures is no live camera", "--view does not apply"):
        assert word in said.complaint


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        ("check c.yaml pictures -o d.yaml", "-o"),
        ("check c.yaml pictures --output d.yaml", "--output"),
        ("check c.yaml pictures --model fisheye", "--model"),
        ("convert c.yaml -o d.yaml --model fisheye", "--model"),
        ("convert c.yaml -o d.yaml --view", "--view"),
    ],
)
def test_calibrate_knows_no_option_that_it_would_not_heed(arguments: str, option: str) -> None:
    Path("pictures").mkdir()
    said = run("calibrate", *arguments.split())
    assert said.code == 2
    assert f"No such option: {option}" in said.stderr
    assert not Path("d.yaml").exists()


def test_a_seed_for_a_real_vehicle_is_said_to_change_nothing() -> None:
    at = ("--uri", "usb://0", "--source", "camera:0", "--dry-run")
    assert "--seed 7" in run("fly", "--seed", "7", *at).complaint
    assert run("fly", *at).stderr == ""


@pytest.mark.parametrize("where", ["afile", "afile/logs"])
@pytest.mark.parametrize("command", ["simulate --only 1", "simulate", "fly"])
def test_a_file_in_the_place_of_the_logs_is_named_with_what_to_do(command: str, where: str) -> None:
    Path("afile").touch()
    said = run(*command.split(), "--log-dir", where)
    assert said.code == 30
    assert where in said.complaint
    assert "name another folder with --log-dir" in said.complaint
