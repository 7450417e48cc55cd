"""A flight's recording: an MCAP file beside the log, with the pictures.

`recorded_pictures` reads the pictures back, `export_mcap` makes such a file of a log. The libraries
are loaded with the first call: most flights of a campaign are not recorded.
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from perchctl.log.place import recording_path
from perchctl.log.read import FlightLog, read_log

if TYPE_CHECKING:
    from perchctl.log.recording.export import Exported
    from perchctl.log.recording.pictures import Picture

__all__ = ["export_mcap", "recorded_pictures", "recording_path"]


def recorded_pictures(
    path: Path | str, *, exact: bool = True, numbers: Container[int] | None = None
) -> Iterator[Picture]:
    """The pictures `(number, t_s, image)`, oldest first, of a recording or of the log that it lies
    beside; of one that was cut off, those that are whole.

    Args:
        exact: every picture must be the flight's to the bit.
        numbers: only the frames of these, the others are not decoded; None is all.

    Errors, with the first picture: NotFound without a recording; InvalidValue where it is none,
    and where this computer's decoder makes other pixels of a JPEG than the flight's did.
    """
    from perchctl.log.recording.pictures import pictures_in

    return pictures_in(recording_path(path), exact, numbers)


def export_mcap(
    log: FlightLog | Path | str, out_path: Path | str, overwrite: bool = False
) -> Exported:
    """Write a flight log as an MCAP file, with the pictures of the recording that lies beside it,
    and beside the file a layout for Foxglove.

    Args:
        log: its path, or one that is read already.
        overwrite: what is there already may be replaced, the recording itself among it.

    Errors: those of `perchctl.log.read.read_log`; InvalidValue for a place that cannot be
    written to.
    """
    from perchctl.log.recording.export import exported

    log = log if isinstance(log, FlightLog) else read_log(log)
    return exported(log, Path(out_path), overwrite)
