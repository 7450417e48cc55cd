"""A vehicle's state estimate, read and nothing else: no parameter set, nothing armed."""

from __future__ import annotations

from collections.abc import Callable

from perchctl.link.cflib_link import CflibLink
from perchctl.profile import LinkConfig


class EstimateLink(CflibLink):
    """A `CflibLink` that only listens. Errors as there."""

    def __init__(self, uri: str, config: LinkConfig, clock: Callable[[], float]) -> None:
        super().__init__(uri, config.model_copy(update={"parameters": {}}), clock)

    def connect(self) -> None:
        """Connect, check the firmware, start telemetry. Bounded."""
        self._open()
        try:
            self._check_firmware()
            self._start_logging()
        except BaseException:
            self._close_link()
            raise
