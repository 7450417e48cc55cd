"""The 24 ways to name the axes of a right-handed world, what a capture says in each, the record of
a comparison by hand, and a library of motion capture that fails."""

from __future__ import annotations

import itertools
from datetime import UTC, datetime, timedelta

import numpy as np

from perchctl.geometry import Array
from perchctl.link import vehicle_uri
from perchctl.positioning import save_comparison
from perchctl.profile import PositioningConfig


def _turns() -> list[Array]:
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            for row, (axis, sign) in enumerate(zip(order, signs, strict=True)):
                turn[row, axis] = sign
            if np.linalg.det(turn) > 0:
                found.append(turn)
    return found


TURNS = _turns()
"""Each (3, 3): true world to the capture's. 24; four of them have z up."""
UPRIGHT = [turn for turn in TURNS if turn[2, 2] == 1.0]


def named_up(turn: Array) -> str:
    """The capture's axis that is up."""
    i = int(np.argmax(np.abs(turn[:, 2])))
    return f"{'-' if turn[i, 2] < 0 else ''}{'xyz'[i]}"


def compared(
    config: PositioningConfig,
    uri: str,
    *,
    ago_s: float = 0.0,
    passed: bool = True,
    found: str = "it turns",
) -> None:
    """As if `perchctl check --lift` had found that, so long ago."""
    at = datetime.now(UTC) - timedelta(seconds=ago_s)
    assert save_comparison(config, vehicle_uri(uri), at, passed, found) is None


Rows = tuple[tuple[float, ...], ...]
Y_UP: Rows = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""The capture's second axis is up, as some systems have it out of the box."""
SWAPPED_XY: Rows = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
"""The capture's axes lie a quarter turn from those along which its bodies were defined."""

LIBRARY = """
import ctypes, math, os, sys, time


class Rotation:
    w, x, y, z = 1.0, 0.0, 0.0, 0.0


class Body:
    rotation = Rotation()

    def __init__(self, x):
        self.position = (x, 0.0, 0.5)


class Client:
    def __init__(self, kind, fault):
        self.kind, self.fault, self.count = kind, fault, 0

    def waitForNextFrame(self):
        self.count += 1
        if self.fault == "silent" or self.fault == "stalls" and self.count > 5:
            time.sleep(60)
        if self.fault == "dies" and self.count > 5:
            print("the camera burnt", file=sys.stderr, flush=True)
            os._exit(7)
        if self.fault == "raises" and self.count > 5:
            raise RuntimeError("subject table changed")
        if self.fault == "prints":
            os.write(2, b"Unrecognized Packet Type." * 4000)
        if self.fault == "pauses" and self.count % 400 == 0:
            time.sleep(0.15)
        if self.fault == "bursts":
            time.sleep(0.0 if self.count % 12 else 0.15)
            return
        time.sleep({"floods": 3e-4, "slow": 0.15}.get(self.fault, 0.002))

    @property
    def rigidBodies(self):
        if self.fault == "empty":
            return {}
        if self.fault == "turns":
            return {("cf", "wand", "cf2")[self.count % 3]: Body(1.0 + 1e-4 * self.count)}
        return {"cf": Body(1.0 + 1e-4 * self.count), "cf2": Body(3.0)}


def connect(kind, options):
    fault = options["hostname"]
    if fault == "hangs":  # as `vicon` does: no other thread of the process gets a turn
        ctypes.PyDLL(None).sleep(60)
    if fault == "aborts":
        print("terminate called after throwing an instance of E", file=sys.stderr)
        print("  what(): Network is unreachable", file=sys.stderr, flush=True)
        os._exit(134)
    if fault == "refuses":
        raise RuntimeError("Error connecting QTM")
    return Client(kind, fault)
"""
"""Stands in the child for the real one; its faults are chosen by the host's name."""
