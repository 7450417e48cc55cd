"""`perchctl hover`: its plan, and one sentence and an exit code for each bad distance or time."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from tests.helpers.commands import elsewhere, run  # noqa: F401
from tests.helpers.flights import SHORT

MINE = f"extends: {SHORT}\nplanner: {{hover: {{below_m: 0.4, duration_s: 9.0}}}}\n"


@pytest.mark.parametrize(("words", "below_m", "duration_s"), [
    ("", 0.4, 9.0), ("--below 0.8", 0.8, 9.0), ("--time 30", 0.4, 30.0),
])  # fmt: skip
def test_an_option_comes_before_the_profile(words: str, below_m: float, duration_s: float) -> None:
    Path("mine.yaml").write_text(MINE)
    planned = run("hover", "-p", "mine.yaml", "--dry-run", *words.split())
    assert planned.code == 0
    wanted = f"hover {below_m:g} m below the target for {duration_s:g} s, then land"
    assert wanted in " ".join(planned.stdout.split())
    record = run("hover", "-p", "mine.yaml", "--dry-run", "--json", *words.split()).stdout
    hover = json.loads(record)["profile"]["planner"]["hover"]
    assert hover == {"below_m": below_m, "duration_s": duration_s}


def test_without_a_profile_of_its_own_it_has_its_defaults() -> None:
    assert "hover 0.5 m below the target for 20 s" in run("hover", "--dry-run").stdout
    assert "mission " not in run("fly", "--dry-run").stdout


@pytest.mark.parametrize("words", [
    "--below 0.1", "--below 2.5", "--below nan", "--time 0", "--time 301", "--time nan",
])  # fmt: skip
def test_a_distance_or_time_out_of_bounds_is_an_invalid_value(words: str) -> None:
    done = run("hover", "--dry-run", *words.split())
    assert (done.code, done.stdout) == (30, "")
    assert f"{words.split()[0]}: found" in done.complaint


def test_commands_that_perch_refuse_a_profile_that_hovers() -> None:
    Path("mine.yaml").write_text(MINE)
    done = run("fly", "-p", "mine.yaml", "--dry-run")
    assert (done.code, done.stdout) == (30, "")
    assert "planner.hover is set" in done.stderr
    assert "perchctl hover" in done.stderr
    Path("air.yaml").write_text(
        "name: air\nvehicles:\n"
        "  - {name: one, profile: mine.yaml, home_m: [0, 0], target_m: [0, 0.1]}\n"
    )
    done = run("fleet", "fly", "air.yaml", "--dry-run")
    assert done.code == 30
    assert "one: planner.hover is set" in done.stderr


def test_a_refusal_names_the_command() -> None:
    Path("bad.yaml").write_text("extends: sim\ncamera: {mount: {rpy_deg: [90, 0, 0]}}\n")
    done = run("hover", "-p", "bad.yaml", "--dry-run")
    assert done.code == 52
    assert "hover would refuse to start: " in done.stderr
