"""The log's header: what a flight was set up with, enough to decide it again elsewhere.

The profile stands there with every key. The files that it names for the camera may be others
by the time of a replay, so what was in them stands there, too; and how the computer calculates.
"""

from __future__ import annotations

import base64
import contextlib
import math
import platform
import zlib
from datetime import UTC, datetime
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import perchctl
from perchctl.calibration import profile_camera
from perchctl.camera import profile_record, without_password
from perchctl.errors import PerchError
from perchctl.profile import Profile, read_mask
from perchctl.record.exact import to_exact
from perchctl.record.fields import FIELDS, FORMAT, SCHEMA_VERSION


def make_header(
    profile: Profile,
    *,
    uri: str,
    source: str,
    seed: int | None = None,
    lockstep: bool = False,
    started: datetime | None = None,
    t0_s: float = 0.0,
) -> dict[str, Any]:
    """Return a log's first record. Without `started` it depends on nothing but its arguments and
    the files that the profile names. `t0_s` is the loop's clock when the log began, or at
    `started`."""
    return {
        "kind": "header",
        "format": FORMAT,
        "version": SCHEMA_VERSION,
        "perchctl": perchctl.__version__,
        "uri": uri,
        "source": without_password(source),
        "seed": seed,
        "lockstep": lockstep,
        "started_utc": started.astimezone(UTC).isoformat(timespec="seconds") if started else None,
        "t0_s": t0_s,
        "profile": profile_record(profile),
        **camera_record(profile),
        **computer_record(),
        "fields": FIELDS,
    }


def camera_record(profile: Profile) -> dict[str, Any]:
    """Return ``camera``, the calibration, and ``mask``, what the gear covers in it. A file that
    cannot be read is left out: the flight says so."""
    with contextlib.suppress(PerchError):
        camera = profile_camera(profile.camera)
        record = {"camera": to_exact(camera)}
        if profile.camera.mask is not None:
            record["mask"] = _packed(read_mask(profile.camera.mask, camera.size_px))
        return record
    return {}


def computer_record() -> dict[str, Any]:
    """Return ``computer``: what the last bits of a sum may depend on."""
    return {
        "computer": {
            "system": platform.system(),
            "machine": platform.machine(),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "opencv": cv2.__version__,
            "arithmetic": arithmetic_fingerprint(),
        }
    }


def _packed(mask: NDArray[np.bool_]) -> str:
    return base64.b64encode(zlib.compress(np.packbits(mask).tobytes(), 9)).decode("ascii")


@cache
def arithmetic_fingerprint() -> str:
    """Return eight hexadecimal digits for how this computer calculates. Where they are the same,
    with the same libraries, single-threaded results are the same to the bit.

    Libraries choose their kernels by the processor, and these round differently in the last bits.
    numpy and OpenCV name what they choose by; the C library and numpy's BLAS are known by the
    results of some small calculations.
    """
    config: Any = np.show_config(mode="dicts")
    kernels = repr((config.get("SIMD Extensions"), cv2.getCPUFeaturesLine()))
    x = np.arange(1, 257) * (math.pi / 97.0)
    functions = (math.sin, math.cos, math.atan, math.exp, math.log, math.sqrt)
    results = [np.array([f(v) for v in x.tolist() for f in functions]), np.exp(-x), x.sum()]
    for n in (2, 3, 4, 6, 8, 12):
        A = np.sin(x[: n * n]).reshape(n, n)
        S = A.dot(A.T) + n * np.eye(n)
        results += [S, np.linalg.solve(S, A), *np.linalg.eigh(S), np.linalg.svd(A)[1]]
    bits = zlib.crc32(kernels.encode())
    for result in results:
        bits = zlib.crc32(np.ascontiguousarray(result).tobytes(), bits)
    return f"{bits:08x}"
