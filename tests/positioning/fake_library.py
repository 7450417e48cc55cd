"""A library `motioncapture` whose faults are chosen by the host's name; in the child it is found
instead of the real one."""

from __future__ import annotations

from pathlib import Path

SOURCE = """
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
        if self.fault != "floods":
            time.sleep(0.002)

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


def write_library(folder: Path) -> None:
    (folder / "motioncapture.py").write_text(SOURCE)
