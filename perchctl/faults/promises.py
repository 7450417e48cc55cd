"""What docs/faults.md promises for when something goes wrong, and whether a flight keeps it.

Its table, "In short", is drawn from `PROMISES`; each fault of the catalogue names the key of one.
"""

from __future__ import annotations

from dataclasses import dataclass

from perchctl.faults.oracle import HELD_ELSEWHERE, UNCONFIRMED
from perchctl.faults.results import End, FaultResult

DOWN: frozenset[End] = frozenset({"perched", "landed"})
CUT: frozenset[End] = frozenset({"perched", "landed", "aborted"})


@dataclass(frozen=True)
class Promise:
    """One row of that table. `ends`: the ends that a flight with such a fault may have.
    `unseen`: it may also end with an unconfirmed landing, or held away from the target by an
    estimate that moved. `names`: a word that its last sentence contains unless it perched."""

    what: str
    happens: str
    ends: frozenset[End] = DOWN
    unseen: bool = False
    names: str = ""

    def is_kept(self, result: FaultResult) -> bool:
        """Return True if the flight ended as promised and nothing avoidable went wrong."""
        if result.counted:
            return False
        if result.outcome == "refused":  # nothing took off
            return True
        if self.unseen and result.row in (UNCONFIRMED, HELD_ELSEWHERE):
            return True
        if result.outcome != "perched" and self.names not in result.reason:
            return False
        return bool(result.expected) or result.outcome in self.ends


PROMISES: dict[str, Promise] = {
    "camera": Promise(
        "camera silent, frozen, snowing, dark, late, lossy; target covered",
        "held after 0.5 s, landed after 3 s; in the ascent it backs off down; landed "
        "where the latency changes by 0.1 s, and named",
    ),
    "mirrored": Promise(
        "picture mirrored",
        "not flown by; landed after the search, and `camera.mirrored` named",
        names="camera.mirrored",
    ),
    "turned": Promise(
        "camera mounted 90 or 180 deg off",
        "stopped and landed within 0.3 m (0.6 m by the target alone), as soon as the target moves "
        "with the vehicle, and the turn that fits named",
        names="camera.mount",
    ),
    "telemetry": Promise(
        "telemetry old or standing still, or a part of it; loop late or hanging",
        "held by the planner from 0.25 s late, by the watchdog after 0.3 s of silence; landed "
        "after 1 s; nothing old proves a contact or a landing",
        unseen=True,
    ),
    "link": Promise(
        "link lost, or the vehicle starts again",
        "a landing is ordered, for which the link is opened once more; a silent vehicle levels "
        "out at 0.5 s and cuts at 2 s by itself, except in its own landing",
        CUT,
    ),
    "packet": Promise(
        "a packet lost or sent twice, at any order",
        "nothing: what must arrive is sent again until it shows",
    ),
    "battery": Promise(
        "battery low under load for 1.5 s, its reading frozen",
        "no new attempt, landing; without a reading no attempt begins, and it lands after 90 s",
    ),
    "estimate": Promise(
        "state estimate jumps, drifts, is no number",
        "held for 0.5 s, then landed where it is; what the magnet holds goes on",
        unseen=True,
    ),
    "positions": Promise(
        "motion capture hides the body, freezes, ends, takes another body for it, is late; a deck "
        "measures no more",
        "what cannot be true is not sent; held after 0.15 s, landed after 0.7 s without a "
        "position, within 1 s without a deck's",
        unseen=True,
    ),
    "heading": Promise(
        "heading jumps by more than 40 deg",
        "down at once, level, by thrust alone",
    ),
    "pushed": Promise(
        "a blow, a gust, a weak motor, another hover thrust",
        "flown out; back to the alignment when it is beside the target",
    ),
    "magnet": Promise(
        "no magnet, a weak one, a slip",
        "caught, one attempt less; the motors stop only after a second of the whole weight",
    ),
    "ceiling": Promise(
        "pressed against something for 0.7 s, ceiling bare or elsewhere",
        "backs off down, or lands when it was the take-off; lands when nothing is found",
    ),
    "beside": Promise(
        "magnet 2 to 20 cm above or below the printed target",
        "perched within the contact's tolerance; what holds it farther away is left holding it "
        "with the motors off, and said so",
        CUT,
    ),
    "moved": Promise(
        "target moved, a second one",
        "followed, or landed after the attempts",
    ),
    "operator": Promise(
        "Ctrl-C once, held, terminal closed",
        "landed; where the magnet holds on, left hanging and said so",
    ),
    "stop": Promise(
        "Ctrl-C twice, or hammered for 2 s",
        "motors cut and locked, repeated until it shows",
        CUT,
    ),
    "disk": Promise(
        "disk full, or hanging",
        "flies on, says so, and exits with 60 where all else went well",
    ),
    "killed": Promise(
        "perchctl suspended, killed",
        "in the air the firmware cuts after 2 s and locks, but finishes its own landing; the log "
        "reads up to its last record",
        CUT | {"gone"},
    ),
    "exception": Promise(
        "perchctl itself fails",
        "the vehicle is landed first, whatever was raised",
        DOWN | {"failed"},
    ),
    "ended": Promise("tumbled, crashed, locked", "stop; the message says to inspect and restart"),
}
