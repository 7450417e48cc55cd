"""What limits a replay, in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import perchctl
from perchctl.log import FlightLog, computer_differences

ON_PICTURES = ("camera", "detector", "pose", "kalman", "merge", "target", "vehicle")
ON_NEITHER = ("link", "simulation", "log")
BEFORE_TAKEOFF = (
    "safety.min_rest_v", "safety.estimator_wait_s", "safety.estimator_variance_m2",
    "safety.ground_z_m", "safety.ground_tolerance_m", "safety.start_tilt_deg",
    "positioning.connect_timeout_s",
)  # fmt: skip
ON_AGES = ("positioning.hold_s", "positioning.land_s", "positioning.latency_s")
"""Of `positioning` these act on the positions' ages, which are recorded; the others on which
positions the vehicle is given."""


def notes_of(
    log: FlightLog, gap: str, ended: str, changed: Sequence[str], *, pictures: bool
) -> Iterator[str]:
    """`ended`: why the pictures do so before the flight; `pictures`: some were looked at."""
    made_by = log.header.get("perchctl")
    if made_by != perchctl.__version__:
        yield (
            f"perchctl {made_by} flew it, and this is {perchctl.__version__}: what differs may be "
            f"what has been changed on purpose since"
        )
    elsewhere = computer_differences(log.header)
    if elsewhere:
        yield f"it was flown with {elsewhere}: the last bits of a number may differ for that alone"
    if log.truncated:
        yield "the log ends in the flight, without its summary: replayed is what is there"
    yield from (note for note in (gap, ended) if note)
    yield from _on_keys(changed, pictures)


def _on_keys(changed: Sequence[str], pictures: bool) -> Iterator[str]:
    def those(*sections: str) -> list[str]:
        return [key for key in changed if key.split(".")[0] in sections]

    told = (
        (
            [] if pictures else those(*ON_PICTURES),
            "what it would change in the pictures cannot be shown, as there are none to look at",
        ),
        (
            [] if pictures else [key for key in changed if key == "safety.max_frame_age_s"],
            "another picture that is let pass or refused changes the camera's age; what it would "
            "change in the target's estimate cannot be shown, as there are no pictures to look at",
        ),
        (
            [key for key in those("positioning") if key not in (*ON_AGES, *BEFORE_TAKEOFF)],
            "which positions the vehicle would have been given, and where it would have taken "
            "itself to be, cannot be shown: a log has only those that it was given",
        ),
        (
            [key for key in changed if key in BEFORE_TAKEOFF],
            "it is asked before take-off only, and a replay begins with the flight",
        ),
        (those(*ON_NEITHER), "a replay has nothing that it acts on"),
    )
    yield from (f"{', '.join(keys)}: {text}" for keys, text in told if keys)
