"""The environment in which libraries calculate as on the oldest processor that they support.

    env $(python -m tests.helpers.processor) pytest

Each library is told to leave out what it says it has here, so no name of a processor's feature
stands in this file, and any version accepts its own. The C library's are few and long known; a
name that it does not know it ignores.
"""

from __future__ import annotations

import platform
import re
from typing import Any

import cv2
import numpy as np

X86 = ("x86_64", "AMD64", "i686")


def numpy_features() -> list[str]:
    """The features beyond its baseline that NumPy uses now."""
    config: Any = np.show_config(mode="dicts")
    return list(config.get("SIMD Extensions", {}).get("found", []))


def opencv_features() -> list[str]:
    """The features beyond its baseline, marked by a star, that OpenCV uses now; one with a
    question mark is not used."""
    return re.findall(r"\*([\w.-]+)(?=\s|$)", cv2.getCPUFeaturesLine())


def oldest_processor() -> dict[str, str]:
    """Environment variables for a new process. NumPy's BLAS and the C library keep their kernels
    on a processor that is not of the x86 family."""
    found = {}
    if features := numpy_features():
        found["NPY_DISABLE_CPU_FEATURES"] = ",".join(features)
    if features := opencv_features():
        found["OPENCV_CPU_DISABLE"] = ",".join(features)
    if platform.machine() in X86:
        found["OPENBLAS_CORETYPE"] = "Prescott"
        found["GLIBC_TUNABLES"] = "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX2_Usable,-FMA_Usable"
    return found


if __name__ == "__main__":
    print(" ".join(f"{name}={value}" for name, value in oldest_processor().items()))
