"""The newest picture of a live source; pure."""

from __future__ import annotations

from perchctl.camera.repeats import Grey, RepeatState, repeated
from perchctl.vision import Frame


class NewestSlot:
    """Keeps the newest picture, at the time at which it came first.

    One that a receiver gives out again takes no new one's place: it would make it look younger
    than it is. Where the new one has been taken already it comes with the same index, and
    `Frame.repeated`: a sign of life, and no measurement. `by_noise`: as `repeated` has it.
    """

    def __init__(self, by_noise: bool = False) -> None:
        self._by_noise = by_noise
        self._frame: Frame | None = None
        self._repeats = RepeatState()
        self.count = 0

    def put(
        self, image: Grey, t_s: float, t_arrival_s: float, encoded: bytes | None = None
    ) -> None:
        """Times of exposure and of arrival; `encoded` as `Frame` has it."""
        self._repeats, again = repeated(self._repeats, image, t_arrival_s, self._by_noise)
        if not again:
            self._frame = Frame(self.count, t_s, image, t_arrival_s, encoded=encoded)
            self.count += 1
        elif self._frame is None or self._frame.repeated:
            self._frame = Frame(self.count - 1, t_s, image, t_arrival_s, repeated=True)

    def take(self) -> Frame | None:
        """Once."""
        frame, self._frame = self._frame, None
        return frame
