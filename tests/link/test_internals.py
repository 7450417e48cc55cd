"""What perchctl uses of cflib without a promise: a rename is noticed, and a dongle is not lost."""

from __future__ import annotations

import threading
from types import ModuleType
from typing import Any

import pytest
from cflib.crazyflie import Crazyflie
from cflib.crtp import radiodriver

from perchctl.errors import UsageError
from perchctl.link import CflibLink, find_uris_and_problem, internals
from perchctl.profile import LinkConfig

NAMES = [internal.name for internal in internals.INTERNALS]


def rename(patch: pytest.MonkeyPatch, owner: Any, name: str) -> None:
    """Let `name` of the owner be called otherwise, as another release of cflib may have it."""
    if isinstance(owner, (type, ModuleType)) or name in vars(type(owner)):
        holder = owner if isinstance(owner, (type, ModuleType)) else type(owner)
        patch.setattr(holder, f"{name}_by_another_name", vars(holder)[name], raising=False)
        patch.delattr(holder, name)
        return
    made = type(owner).__init__

    def init(self: Any, *given: Any, **named: Any) -> None:
        made(self, *given, **named)
        vars(self)[f"{name}_by_another_name"] = vars(self).pop(name, None)

    patch.setattr(type(owner), "__init__", init)


def test_the_installed_cflib_has_them_all() -> None:
    internals.check_internals()
    assert len({(i.name, i.owner) for i in internals.INTERNALS}) == len(NAMES)


@pytest.mark.parametrize("internal", internals.INTERNALS, ids=NAMES)
def test_a_rename_is_noticed_before_anything_is_opened(
    internal: internals.Internal, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename(monkeypatch, internal.owner(), internal.name)
    with pytest.raises(UsageError, match=rf"^cflib 0\.1\.\d+ has no {internal.name}, "):
        CflibLink("udp://127.0.0.1:9", LinkConfig(), lambda: 0.0).connect()
    with pytest.raises(UsageError, match=r"'cflib>=0\.1\.34,<0\.2'$"):
        find_uris_and_problem()


def test_a_cflib_whose_parts_are_made_otherwise_is_no_traceback(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(radiodriver, "_RadioDriverThread")
    with pytest.raises(UsageError, match="has no _retry_before_disconnect"):
        internals.check_internals()


class DeadDongle:
    """A dongle's thread that has ended; meanwhile another link wants to open it anew."""

    def __init__(self) -> None:
        self.opener = threading.Thread(target=self._open_anew)
        self.opened = threading.Event()

    def _open_anew(self) -> None:
        with radiodriver.RadioManager._lock:
            radiodriver.RadioManager._radios[0] = NEW_DONGLE
        self.opened.set()

    def is_alive(self) -> bool:
        self.opener.start()
        self.opened.wait(0.2)  # in vain while the manager's lock is held
        return False


class Alive:
    _radio = object()  # its dongle is open

    def is_alive(self) -> bool:
        return True


NEW_DONGLE = Alive()


def test_a_dongle_that_another_link_opened_anew_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    dead = DeadDongle()
    monkeypatch.setattr(radiodriver.RadioManager, "_radios", [dead])
    internals.forget_dead_dongle("radio://0/80/2M/E7E7E7E7E7")
    dead.opener.join(5.0)
    assert radiodriver.RadioManager._radios == [NEW_DONGLE]
    internals.forget_dead_dongle("radio://0/80/2M/E7E7E7E7E7")
    assert radiodriver.RadioManager._radios == [NEW_DONGLE]


@pytest.mark.parametrize("uri", ["udp://127.0.0.1:9", "radio://3/80/2M", "radio://E7E7E7E7E7/80"])
def test_a_uri_without_such_a_dongle_is_left_alone(
    uri: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(radiodriver.RadioManager, "_radios", [None])
    monkeypatch.setattr(radiodriver.crazyradio, "get_serials", lambda: ())
    internals.forget_dead_dongle(uri)
    assert radiodriver.RadioManager._radios == [None]


def test_the_error_callback_is_the_one_that_a_driver_gets(monkeypatch: pytest.MonkeyPatch) -> None:
    """cflib hands `_link_error_cb` to its driver when the link is opened, not before."""
    cf, reported = Crazyflie(), list[str]()
    internals.replace_error_callback(cf, reported.append)
    monkeypatch.setattr("cflib.crtp.get_link_driver", lambda uri, statistics, error: error("gone"))
    cf.open_link("udp://127.0.0.1:9")
    assert reported == ["gone"]
