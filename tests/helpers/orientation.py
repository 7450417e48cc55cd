"""Pictures and videos that note how a viewer should turn them, as cameras write them."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from perchctl.camera import Grey

TAG = 274
TURNS = (2, 3, 6, 8)
"""Mirrored, upside down, and a quarter turn to each side."""


def turned_picture(image: Grey, form: str, orientation: int) -> bytes:
    """The bytes of a picture file of PIL's `form`, which notes the orientation; losslessly except
    for JPEG."""
    exif = Image.Exif()
    exif[TAG] = orientation
    stream = BytesIO()
    picture = Image.fromarray(image)
    if form == "TIFF":
        picture.save(stream, form, tiffinfo={TAG: orientation})
    elif form == "WEBP":
        picture.save(stream, form, exif=exif, lossless=True)
    elif form == "JPEG":
        picture.save(stream, form, exif=exif, quality=95)
    else:
        picture.save(stream, form, exif=exif)
    return stream.getvalue()


def turn_video(file: Path, degrees: int) -> None:
    """Note in an mp4 file that a viewer turns it clockwise by that, as a phone does: the display
    matrix of the track header, fixed point with 16 bits behind the point."""
    data = bytearray(file.read_bytes())
    matrix_at = data.index(b"tkhd") + 4 + 40
    c, s = round(np.cos(np.radians(degrees))), round(np.sin(np.radians(degrees)))
    struct.pack_into(
        ">9i", data, matrix_at, c << 16, s << 16, 0, -s << 16, c << 16, 0, 0, 0, 1 << 30
    )
    file.write_bytes(data)
