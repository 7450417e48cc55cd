"""The log's header: the setup of a flight, complete enough to replay the flight on another
computer.

The header contains the profile with every key. The calibration and mask files named in the profile
may have changed by the time of a replay, so their content is included as well, and so is a
fingerprint of the computer's arithmetic.
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
from perchctl.mission import TickRecord
from perchctl.profile import Profile, read_mask
from perchctl.record.exact import exact_fields, to_exact_json
from perchctl.record.fields import FIELDS, FORMAT, SCHEMA_VERSION


def make_header(
    profile: Profile,
    *,
    uri: str,
    source: str,
    seed: int | None = None,
    fault: str | None = None,
    lockstep: bool = False,
    started: datetime | None = None,
    t0_s: float = 0.0,
) -> dict[str, Any]:
    """The first record of a log. Without `started`, it depends only on the other arguments and on
    the files named in the profile. `t0_s` is the time on the loop's clock at the start of the
    log. `fault` describes the fault that is injected into a simulated flight, if any."""
    return {
        "kind": "header",
        "format": FORMAT,
        "version": SCHEMA_VERSION,
        "perchctl": perchctl.__version__,
        "uri": uri,
        "source": without_password(source),
        "seed": seed,
        **({} if fault is None else {"fault": fault}),
        "lockstep": lockstep,
        "started_utc": started.astimezone(UTC).isoformat(timespec="seconds") if started else None,
        "t0_s": t0_s,
        "profile": profile_record(profile),
        **camera_record(profile),
        **computer_record(),
        "fields": FIELDS,
        "turn_fields": turn_fields(),
    }


@cache
def turn_fields() -> dict[str, list[str]]:
    """Return the names of the fields that are written for a turn (one iteration of the flight
    loop), keyed by dataclass.

    From these names, a later version of perchctl can tell which of its fields did not exist yet
    when the log was written. Without the names, such a field could not be distinguished from a
    field that is left out because it is None.
    """
    names: dict[str, list[str]] = {}
    for field in exact_fields(TickRecord):
        of = names.setdefault(field.owner, [])
        if field.name not in of:
            of.append(field.name)
    return names


def camera_record(profile: Profile) -> dict[str, Any]:
    """Return the header's ``camera`` (the calibration) and ``mask`` (the pixels that the gear
    covers); an unreadable file is left out."""
    with contextlib.suppress(PerchError):
        camera = profile_camera(profile.camera)
        record = {"camera": to_exact_json(camera)}
        if profile.camera.mask is not None:
            record["mask"] = _packed(read_mask(profile.camera.mask, camera.size_px))
        return record
    return {}


def computer_record() -> dict[str, Any]:
    """Return the header's ``computer``: the hardware and libraries that rounding may depend on."""
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


# --- A fingerprint of this computer's arithmetic ---
# Libraries choose different code for different processors: numpy's BLAS and vector functions,
# OpenCV's filters, the sine of the C library. The last bits of a pose therefore depend on the
# processor.


_SIDES = (2, 3, 4, 6, 8, 12)


@cache
def arithmetic_fingerprint() -> str:
    """Return eight hexadecimal digits that identify the processor's arithmetic.

    If the digits and the libraries are the same, single-threaded results are bit-identical.
    """
    bits = zlib.crc32(repr((_kernels(), cv2.getCPUFeaturesLine())).encode())
    for part in (_libm_probe(), *_numpy_probes(), *_opencv_probes()):
        bits = zlib.crc32(np.ascontiguousarray(part).tobytes(), bits)
    return f"{bits:08x}"


def _kernels() -> Any:
    config: Any = np.show_config(mode="dicts")
    return config.get("SIMD Extensions", {}) if isinstance(config, dict) else {}


def _grid() -> Any:
    return np.arange(1, 257) * (math.pi / 97.0)


def _libm_probe() -> Any:
    functions = (math.sin, math.cos, math.atan, math.exp, math.log, math.sqrt)
    values = [f(x) for x in _grid().tolist() for f in functions]
    return np.array(values + [math.hypot(x, 1.0 / x, 0.3) for x in _grid().tolist()])


def _numpy_probes() -> list[Any]:
    x = _grid()
    found = [np.sin(x), np.cos(x), np.exp(-x), np.arctan2(x, 2.0), x.sum(), np.dot(x, x)]
    for n in _SIDES:
        A = np.sin(x[: n * n]).reshape(n, n)
        S = A.dot(A.T) + n * np.eye(n)
        found += [S, np.linalg.solve(S, A), np.linalg.inv(S), *np.linalg.eigh(S)]
        found += [np.linalg.svd(A)[1], A.dot(A[0]), np.einsum("ij,jk->ik", A, S)]
    return found


def _opencv_probes() -> list[Any]:
    y, x = np.mgrid[0:64, 0:96]
    image = np.asarray(128 + 90 * np.sign((x - 40) * (y - 30)) + (7 * x + 13 * y) % 29, np.uint8)
    corners = np.array([[[40.3, 30.4]]], np.float32)
    way = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 1e-4)
    K = np.array([[300.0, 0.0, 48.0], [0.0, 300.0, 32.0], [0.0, 0.0, 1.0]])
    points = np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    turned, moved = np.array([0.1, -0.2, 0.3]), np.array([0.1, 0.2, 9.0])
    seen, by_place = cv2.projectPoints(points, turned, moved, K, np.array([0.1, -0.05, 0.0, 0.0]))
    _, r, t = cv2.solvePnP(points, seen, K, None, flags=cv2.SOLVEPNP_IPPE)
    return [
        cv2.GaussianBlur(image.astype(np.float32), (5, 5), 1.1),
        cv2.Sobel(image, cv2.CV_32F, 1, 0),
        cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), way),
        cv2.warpPerspective(image, K / 300.0 + 0.001, (48, 48)),
        cv2.Rodrigues(turned)[0],
        seen,
        by_place,
        r,
        t,
    ]
