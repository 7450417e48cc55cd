"""Where the results of `perchctl track` go: lines, a CSV and a video."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

from perchctl.display import Sketch
from perchctl.track.files import CsvFile, OverlayFile
from perchctl.track.result import Tracked, text_line, text_rows, track_record
from perchctl.vision import CameraModel

LIVE_RATE_HZ = 30.0


@dataclass(frozen=True)
class OutputOptions:
    """What is written. `lines` go to stdout, as JSON or as text; paths are None for no file."""

    lines: bool = True
    as_json: bool = False
    csv: Path | None = None
    overlay: Path | None = None


class Outputs:
    """The lines on `out`, the CSV and the video of one run.

    Errors: InvalidValue for a file that cannot be written, also from `add` and `close`.
    """

    def __init__(
        self, options: OutputOptions, camera: CameraModel, rate_hz: float | None, out: TextIO
    ) -> None:
        """`rate_hz` of a recording; None for a live source."""
        self._options, self._out = options, out
        self._flush = rate_hz is None  # a live result is worth nothing late
        self._csv: CsvFile | None = None
        self._overlay: OverlayFile | None = None
        try:
            if options.csv:
                self._csv = CsvFile(options.csv)
            if options.overlay:
                self._overlay = OverlayFile(options.overlay, camera, rate_hz or LIVE_RATE_HZ)
        except BaseException:
            self.close(keep=False)
            raise

    def add(self, tracked: Tracked, sketch: Sketch, drawn: bool = True) -> None:
        """`drawn` false leaves the picture out of the video: of two fields, one is drawn."""
        if self._options.lines:
            line = (
                json.dumps(track_record(tracked), allow_nan=False)
                if self._options.as_json
                else text_line(tracked)
            )
            print(line, file=self._out, flush=self._flush)
        if self._csv is not None:
            self._csv.add(tracked)
        if self._overlay is not None and drawn:
            text = tuple(f"{name} {value}" for name, value in text_rows(tracked))
            self._overlay.add(tracked.t_s, replace(sketch, text=text))

    def close(self, keep: bool) -> None:
        """Put the files in their places, or remove them. A second call does nothing."""
        if self._csv is not None:
            csv, self._csv = self._csv, None
            csv.close(keep)
        if self._overlay is not None:
            overlay, self._overlay = self._overlay, None
            overlay.close(keep)
