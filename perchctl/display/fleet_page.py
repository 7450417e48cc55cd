"""The live page for a fleet: a tile with the camera image of each vehicle, and buttons to stop.

Each vehicle's process serves its own images (`FlightPage`). The page's threads fetch an image when
a browser requests it, so that images never use the connection that carries commands.
"""

from __future__ import annotations

import contextlib
import http.client
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from perchctl.display.fleet_panel import FleetRow
from perchctl.display.page import PERCH_STEPS
from perchctl.display.serve import Page
from perchctl.mission import Phase

EVENTS_SHOWN = 200
"""Number of event lines on the page. Larger: the browser receives more data. Smaller: a page that
is opened late does not show the beginning of a long flight."""
PICTURE_TIMEOUT_S = 0.5
"""Timeout for a vehicle's process to deliver an image, s. Longer: a process that does not respond
delays the other tiles. Shorter: images are missing if the computer is busy."""
LARGEST_PICTURE_BYTES = 2_000_000
"""Largest JPEG, bytes. Larger: invalid data could fill the memory. Smaller: large images are not
shown."""


class FleetPage(Page):
    """Serves the page until closed. Only the methods `end` and `close` wait.

    Args:
        count: number of vehicles in the fleet.
        on_land: called when STOP ALL is pressed, in a thread of the page.
        on_cut: called in the same way when STOP ALL is pressed again.
        on_land_one: called in the same way, with the vehicle's number (from 1), when Land is
            pressed on a tile.
    """

    HTML = "fleet.html"

    def __init__(
        self,
        title: str,
        count: int,
        on_land: Callable[[], None],
        on_cut: Callable[[], None],
        on_land_one: Callable[[int], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._rows: tuple[FleetRow, ...] = ()
        self._reached: dict[str, int] = {}
        self._events: deque[str] = deque(maxlen=EVENTS_SHOWN)
        orders: dict[str, Callable[[], object]] = {"land": on_land, "cut": on_cut}
        for number in range(1, count + 1):
            orders[f"land/{number}"] = partial(on_land_one, number)
        super().__init__(title, orders, clock)
        self.set_state(self._tiles, live=False)

    def show(self, rows: Sequence[FleetRow], *, live: bool = True) -> None:
        """Show these vehicles. With `live`, the page warns if this method is no longer called."""
        for row in rows:
            if row.hangs or row.phase == Phase.PERCHED.value:
                self._reached[row.name] = len(PERCH_STEPS)
            elif row.phase in PERCH_STEPS:
                self._reached[row.name] = PERCH_STEPS.index(row.phase)
        self._rows = tuple(rows)
        self.set_state(self._tiles, live=live and not all(row.has_ended for row in rows))

    def event(self, line: str) -> None:
        """Add a line to the list of events, which is also shown if the page is opened later."""
        self._events.append(line)

    def picture(self, name: str) -> bytes | None:
        """The newest image from the vehicle with this number; None if there is currently none."""
        port = next((r.picture_port for r in self._rows if str(r.number) == name), None)
        return None if port is None else _fetch_picture(port)

    def _tiles(self) -> dict[str, Any]:
        rows = self._rows
        return {
            "steps": PERCH_STEPS,
            "vehicles": [self._tile(row) for row in rows],
            "events": list(self._events),
            "over": bool(rows) and all(row.has_ended for row in rows),
        }

    def _tile(self, row: FleetRow) -> dict[str, Any]:
        return {
            "number": row.number,
            "name": row.name,
            "phase": row.phase,
            "reason": row.reason,
            "values": row.texts(),
            "reached": self._reached.get(row.name, -1),
            "over": row.has_ended,
            "hangs": row.hangs,
            "bad": row.is_silent or (row.has_ended and not row.hangs),
            "silent": row.is_silent,
            "picture": row.picture_port is not None,
            "landed": f"land/{row.number}" in self._ordered,
        }


def _fetch_picture(port: int) -> bytes | None:
    """Fetch the newest image from the page at this local port; None if that page has no image."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PICTURE_TIMEOUT_S)
    with contextlib.closing(connection):
        try:
            connection.request("GET", "/picture")
            answer = connection.getresponse()
            data = answer.read(LARGEST_PICTURE_BYTES + 1)
        except (OSError, http.client.HTTPException):
            return None
    is_picture = answer.status == 200 and answer.getheader("Content-Type") == "image/jpeg"
    return data if is_picture and len(data) <= LARGEST_PICTURE_BYTES else None
