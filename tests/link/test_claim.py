"""A vehicle is one program's at a time."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from perchctl.errors import ConnectionFailed, InvalidValue
from perchctl.link import connection, vehicle_uri
from perchctl.link.connection import claim, open_connection, plain_cause

RADIO = "radio://0/80/2M/E7E7E7E701"
_HOLDS = """
import sys
from perchctl.link.connection import claim
held = claim(sys.argv[1])
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


@contextlib.contextmanager
def another_program(uri: str) -> Iterator[subprocess.Popen[str]]:
    """One that holds the vehicle, until it is killed."""
    child = subprocess.Popen(
        [sys.executable, "-c", _HOLDS, uri],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == "held\n"
        yield child
    finally:
        child.kill()
        child.communicate()


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (RADIO, "radio://1/80/2M/e7e7e7e701?rate_limit=100", True),  # by another dongle
        ("radio://0/80/2M/0000000001", "radio://0/80/2M/1", True),
        ("radio://0", "radio://0/2/2M/E7E7E7E7E7", True),
        (RADIO, "radio://0/81/2M/E7E7E7E701", False),  # its twin on another channel
        (RADIO, "radio://0/80/1M/E7E7E7E701", False),
        (RADIO, "radio://0/80/2M/E7E7E7E702", False),
        ("udp://localhost:19850", "udp://127.0.0.1:19850", True),
        ("udp://LocalHost:19850", "UDP://127.0.0.1:19850", True),
        ("tcp://Bench:5000", "tcp://bench:5000", True),
        ("Radio://0/80/2m/E7E7E7E701", RADIO, True),
        ("serial:///dev/ttyA", "serial:///dev/ttya", False),
        ("udp://127.0.0.1:19851", "udp://127.0.0.1:19850", False),
        ("usb://0", "usb://1", False),
    ],
)
def test_which_uris_are_of_one_vehicle(one: str, other: str, same: bool) -> None:
    assert (vehicle_uri(one) == vehicle_uri(other)) is same


def test_a_second_program_is_refused_and_told_who_has_it_until_that_one_is_gone() -> None:
    with another_program(RADIO) as child:
        with pytest.raises(ConnectionFailed, match=f"process {child.pid}: "):
            claim(RADIO.replace("radio://0", "radio://1"))
        twin = claim("radio://0/80/2M/E7E7E7E702")
        assert twin is not None
        twin.release()
        child.kill()  # it has no time to tidy up
        child.wait()
        mine = claim(RADIO)
        assert mine is not None
        mine.release()


def test_what_was_released_is_free_and_leaves_nothing_behind(folder: Path) -> None:
    for _ in range(2):
        mine = claim(RADIO)
        assert mine is not None
        with pytest.raises(ConnectionFailed, match="in use by another program"):
            claim(RADIO)
        mine.release()
        mine.release()
    assert not list(folder.rglob("*.lock"))


def test_not_one_packet_reaches_a_vehicle_that_is_anothers() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind(("127.0.0.1", 0))
        vehicle.settimeout(0.05)
        uri = f"udp://127.0.0.1:{vehicle.getsockname()[1]}"
        with another_program(uri):
            with pytest.raises(ConnectionFailed, match="two would steer it two ways"):
                open_connection(uri, 5.0)
            with pytest.raises(TimeoutError):
                vehicle.recv(64)


def test_a_connection_that_comes_to_nothing_keeps_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(uri: str, timeout_s: float) -> connection.Connection:
        raise ConnectionFailed("no answer")

    monkeypatch.setattr(connection, "_opened", nobody)
    for _ in range(2):
        with pytest.raises(ConnectionFailed, match="no answer"):
            open_connection(RADIO, 5.0)


def test_without_a_place_for_the_lock_it_flies_all_the_same(folder: Path) -> None:
    (folder / "perchctl").write_text("")
    assert claim(RADIO) is None


def test_a_cache_folder_that_is_a_file_is_told_by_what_chooses_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "file").write_text("")
    monkeypatch.setattr(connection, "user_cache_folder", lambda: folder / "file" / "perchctl")
    with pytest.raises(InvalidValue, match=r"cannot be written: .*: set XDG_CACHE_HOME to"):
        connection.Connection()


def test_a_radio_that_another_program_has_open_is_named_as_that() -> None:
    """As cflib reports it: the error, then its traceback, which names the Crazyradio."""
    said = plain_cause(
        "Couldn't load link driver: [Errno 16] Resource busy\n\nTraceback ...\n  crazyradio.py, "
        "line 130, in __init__\n    self.dev.set_configuration(1)\nCrazyradio"
    )
    assert "another program has it open" in said
    assert "radio://1" in said
    assert "udev" not in said


def test_who_holds_it_is_told_without_a_password(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["/x/perchctl/__main__.py", "fly", "--source", "rtsp://me:secret@cam/s"]
    monkeypatch.setattr(sys, "argv", words)
    held = claim(RADIO)
    assert held is not None
    try:
        with pytest.raises(ConnectionFailed, match="perchctl fly --source rtsp://cam/s") as caught:
            claim(RADIO)
        assert "secret" not in str(caught.value)
        assert "__main__" not in str(caught.value)
    finally:
        held.release()
