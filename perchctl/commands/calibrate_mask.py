"""`perchctl calibrate --mask`: what the vehicle's own gear covers, learned from any source."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from perchctl.calibration import Grey, learn_gear, mask_png
from perchctl.camera import FrameSource
from perchctl.commands.calibrate_source import Source
from perchctl.commands.interrupt import Stopper
from perchctl.commands.output import print_record, say
from perchctl.errors import TimedOut
from perchctl.files import check_output, write_files

LIVE_S = 20.0
"""For which a live camera is looked at."""
_PAUSE_S = 0.005


def write_mask(source: Source, output: Path, force: bool, as_json: bool) -> int:
    """Learn the mask and write it; returns the exit code.

    Errors: NotFound, InvalidValue, TimedOut (a silent camera).
    """
    check_output(output, (".png",), force, "a mask's format")
    with contextlib.ExitStack() as stack:
        frames = source.open()
        stack.callback(frames.close)
        stop = stack.enter_context(Stopper().installed())
        if frames.live:
            say(f"turn the vehicle about for {LIVE_S:g} s (Ctrl-C ends and writes the mask)")
        gear = learn_gear(_pictures(frames, stop.requested.is_set))
    write_files({output: mask_png(gear)})
    say(
        f"wrote {output}: the vehicle covers {100 * gear.share:.1f} % of the picture, by "
        f"{gear.pictures} pictures; set camera.mask to it"
    )
    if as_json:
        height, width = gear.covered.shape
        record = {"file": str(output), "covered": round(gear.share, 4)}
        print_record(record | {"pictures": gear.pictures, "size_px": [width, height]})
    else:
        print(output)
    return 0


def _pictures(source: FrameSource, stopped: Callable[[], bool]) -> Iterator[Grey]:
    """Those of a recording, or of a camera for some seconds."""
    start_s = time.monotonic()
    while not (stopped() or source.finished):
        now_s = time.monotonic()
        frame = source.poll(now_s)
        if frame is not None:
            yield frame.image
        elif source.live:
            problem = source.problem(now_s)
            if problem is not None:
                raise TimedOut(problem)
            time.sleep(_PAUSE_S)
        if source.live and now_s - start_s > LIVE_S:
            return
