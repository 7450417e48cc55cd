"""A flight of the corpus with the decisions of this process's planner in it.

What was decided on another computer may differ in the last bits. Tests that count bits take a
flight from here: it was decided where it is replayed.
"""

from __future__ import annotations

import gzip
import json
from dataclasses import replace
from functools import cache

from perchctl.mission import load_table, step_mission
from perchctl.record import json_line, read_log, to_exact_json
from perchctl.record.header import computer_record
from perchctl.record.read import parse_turn
from tests.helpers.flights import ROOT

FLIGHTS = ROOT / "tests" / "data" / "flights"
_DECIDED = ("phase", "row", "held", "attempts", "command")
_SINCE_4 = ("outcome", "reason")


@cache
def decided_here(name: str) -> tuple[bytes, ...]:
    """The lines of the log; all else in them is as it was recorded."""
    path = FLIGHTS / f"{name}.jsonl.gz"
    header, *lines = gzip.decompress(path.read_bytes()).splitlines(keepends=True)
    changed = json.loads(header) | computer_record()
    found, state = [json_line(changed)], None
    log = read_log(path)
    profile, records = log.flown_profile, iter(log.turn_records)
    if not log.has_position_variance:  # as the replay does
        profile = profile.with_({"link.unreported": ["variance", *profile.link.unreported]})
    table = load_table(profile.planner.rows)
    names = _DECIDED + (_SINCE_4 if changed["version"] >= 4 else ())
    for line in lines:
        record = json.loads(line)
        turn = parse_turn(next(records)) if record["kind"] == "turn" else None
        if turn is None or turn.observation is None or turn.role == "waiting":
            found.append(line)
            continue
        new, command = step_mission(state, turn.observation, profile, table)
        decided = to_exact_json(
            replace(
                turn,
                phase=new.phase,
                transition_name=new.transition_name,
                is_holding_position=bool(new.hold_reason),
                failed_attempts=new.failed_attempts,
                command=command,
                outcome=new.outcome,
                reason=new.transition_reason,
            )
        )
        rest = {key: value for key, value in record.items() if key not in names}
        found.append(json_line(rest | {key: decided[key] for key in names if key in decided}))
        if turn.role == "flown":
            state = new
    return tuple(found)
