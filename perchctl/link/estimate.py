"""A vehicle's state estimate, read and nothing else: no parameter set, nothing armed."""

from __future__ import annotations

from perchctl.link.cflib_link import CflibLink
from perchctl.link.connection import Connection
from perchctl.link.prepare import check_firmware


class EstimateLink(CflibLink):
    """A `CflibLink` that commands nothing, not even at its end. Errors as there."""

    def close(self) -> None:
        """Leave at once and without cflib's farewell: the vehicle may fly for another."""
        self._leave(farewell=False)

    def _may_say_farewell(self) -> bool:
        return False  # neither when connecting fails half-way

    def _prepare(self, connection: Connection) -> None:
        check_firmware(connection.cf, self._uri)
        self._start_logging(connection)
