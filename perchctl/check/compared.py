"""Whether `fly` finds a comparison by hand of this motion capture, and the writing of one."""

from __future__ import annotations

from datetime import datetime

from perchctl.check.row import Row, Verdict, failed, passed, warned
from perchctl.link import vehicle_uri
from perchctl.positioning import (
    Comparison,
    ComparisonRecord,
    load_comparison,
    save_comparison,
)
from perchctl.profile import PositioningConfig

NAME = "compared"


def kept(lifted: Row, config: PositioningConfig, uri: str, now: datetime) -> Row:
    """Write down what the hand found, and the row of it. A lift that told nothing is none."""
    vehicle = vehicle_uri(uri)
    if lifted.verdict is Verdict.SKIPPED:
        return row(load_comparison(config, vehicle), now)
    record = Comparison(now, lifted.verdict is Verdict.PASS, lifted.found)
    why = save_comparison(config, vehicle, record)
    if why is None:
        return row(record, now)
    standing = load_comparison(config, vehicle)
    if not record.passed and standing.objection(now) is None:
        return failed(
            NAME, f"what was found could not be written, and fly goes by an older pass: {why}",
            "free some space, or give back the right to write there; do not fly before",
        )  # fmt: skip
    return warned(NAME, f"not written, so fly does not know of it: {why}", "then once more")


def row(record: ComparisonRecord, now: datetime) -> Row:
    objected = record.objection(now)
    if objected is None:
        assert isinstance(record, Comparison)
        return passed(NAME, record.text(now))
    found, advice = objected
    return warned(NAME, f"{found}; fly refuses", advice)


def comparison_rows(
    config: PositioningConfig, uri: str, now: datetime, *, simulated: bool
) -> list[Row]:
    """None with decks, nor for the simulator's own vehicle, whose room is right as it is built."""
    if config.by != "mocap" or simulated:
        return []
    return [row(load_comparison(config, vehicle_uri(uri)), now)]
