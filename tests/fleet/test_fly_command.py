"""`perchctl fleet fly`: what it refuses before it starts, and whole flights in real time."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.display.fleet_panel import FleetRow, fleet_table
from perchctl.record import read_log
from tests.helpers.commands import run, run_apart

TWO = """\
name: two
defaults: {profile: sim, uri: "sim://", source: "sim:"}
order: together
vehicles:
  - {name: north, home_m: [0, 0], target_m: [0.2, 0.1]}
  - {name: east, home_m: [2.6, 0], target_m: [2.8, 0]URI}
"""


def two(folder: Path, more: str = "") -> Path:
    path = folder / "two.yaml"
    path.write_text(TWO.replace("URI", more), encoding="utf-8")
    return path


def test_a_dry_run_shows_the_plan_and_starts_nothing(tmp_path: Path) -> None:
    done = run("fleet", "fly", "--dry-run", "--log-dir", str(tmp_path / "logs"))
    assert done.code == 0
    assert "group 1: north, east" in done.stdout
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize("extra", [(), ("--dry-run",)])
def test_two_on_one_dongle_are_refused_before_anything_starts(
    tmp_path: Path, extra: tuple[str, ...]
) -> None:
    air = two(tmp_path, ", uri: 'radio://0/80/2M/E7E7E7E702', source: 'camera:1'")
    text = air.read_text().replace("name: north", "name: north, uri: 'radio://0/80/2M/E7E7E7E701'")
    air.write_text(text.replace('source: "sim:"', 'source: "camera:0"'), encoding="utf-8")
    done = run("fleet", "fly", str(air), *extra)
    assert done.code == 2
    assert "north and east share dongle 0" in done.complaint


def test_nobody_to_ask_is_no_yes(tmp_path: Path) -> None:
    air = two(tmp_path, ", uri: 'udp://127.0.0.1:9', source: 'http://127.0.0.1:9/'")
    done = run("fleet", "fly", str(air))
    assert done.code == 2
    assert "about to arm 2 vehicles, and there is nobody to ask: add --yes" in done.stderr


def test_the_panel_has_a_line_for_each_in_80_columns() -> None:
    from rich.console import Console

    rows = [
        FleetRow(
            number=number,
            name=f"vehicle-{number}",
            phase="ESTIMATE",
            reason="steady again, trying once more, and a reason that is longer than the panel",
            height_m=12.34,
            error_m=1.234,
            battery_v=3.78,
            link_s=9.99,
        )
        for number in range(1, 33)
    ]
    console = Console(width=80)
    with console.capture() as captured:
        console.print(fleet_table(rows, "below", "above"))
    lines = captured.get().splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) == len(rows) + 3
    shown = lines[3]
    assert all(part in shown for part in ("vehicle-2", "ESTIMATE", "12.34 m", "123.4 cm", "3.78 V"))


@pytest.mark.long
def test_one_that_does_not_answer_and_nothing_arms(tmp_path: Path) -> None:
    """Its camera does not either, and is asked first."""
    bad = two(tmp_path, ", uri: 'udp://127.0.0.1:9', source: 'http://127.0.0.1:9/'")
    done = run_apart("fleet", "fly", str(bad), "--yes", "--log-dir", str(tmp_path / "logs"))
    sentence = done.stderr.splitlines()[-1]
    assert done.code == 40, done.stderr
    assert sentence.startswith("perchctl: east: http://127.0.0.1:9/ gave no picture")
    assert sentence.endswith("no vehicle was armed")
    assert "APPROACH" not in done.stderr
    assert not list(tmp_path.glob("logs/*"))


@pytest.mark.long
def test_four_vehicles_fly_in_real_time(tmp_path: Path) -> None:
    """The shipped fleet, as a newcomer flies it. What hangs is asserted for most of them: on a
    computer that is busy with other tests, a vehicle may land."""
    done = run_apart("fleet", "fly", "--json", "--log-dir", str(tmp_path), timeout_s=240.0)
    record = json.loads(done.stdout)
    folder = Path(record["folder"])
    assert record["hanging"] >= 3, done.stderr
    assert (done.code == 0) == (record["hanging"] == 4)
    assert json.loads((folder / "fleet.json").read_text())["vehicles"] == record["vehicles"]
    for vehicle in record["vehicles"]:
        assert read_log(folder / vehicle["log"]).header["seed"] == vehicle["seed"]
    south = record["vehicles"][2]
    assert all(v["ended_s"] < south["ended_s"] for v in record["vehicles"][:2])
