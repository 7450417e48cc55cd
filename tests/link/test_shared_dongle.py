"""A dongle that dies under cflib's own links, without a hub: it is opened again, and once."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from cflib.crtp.radiodriver import RadioDriver

from perchctl.link import internals
from tests.helpers.dongle import UsbPort, attach, talkers, uris
from tests.helpers.waiting import until

TWO = uris(2)


def test_two_links_that_meet_a_dead_dongle_open_it_once() -> None:
    """Each forgets it and opens it anew: neither removes what the other has opened."""
    with pytest.MonkeyPatch.context() as patch:
        port = UsbPort(dict(talkers(TWO)))
        attach(port, patch)
        for _ in range(5):
            answered = [threading.Event(), threading.Event()]
            drivers, gate = [RadioDriver(), RadioDriver()], threading.Barrier(2)
            opened = port.opened

            def link(number: int, drivers: Any, gate: Any, answered: Any) -> None:
                gate.wait(20.0)
                internals.forget_dead_dongle(TWO[number])
                drivers[number].connect(TWO[number], None, lambda message: None)
                internals.count_answers(
                    drivers[number], lambda answer: answer and answered[number].set()
                )

            links = [
                threading.Thread(target=link, args=(number, drivers, gate, answered))
                for number in range(2)
            ]
            for thread in links:
                thread.start()
            for thread in links:
                thread.join(20.0)
            assert all(event.wait(20.0) for event in answered)
            assert port.opened == opened + 1
            dongle = internals.dongle_thread(TWO[0])
            port.unplug()
            dongle.join(20.0)
            for driver in drivers:
                internals.close_radio(driver, dongle, 20.0)
                assert not driver._radio
            port.plug_in()


def test_a_link_of_its_own_survives_a_second_unplugging() -> None:
    """cflib registers a link even if its dongle does not open, and then never closes it again."""
    with pytest.MonkeyPatch.context() as patch:
        port = UsbPort(dict(talkers(TWO[:1])))
        attach(port, patch)
        for _ in range(3):
            driver, answered = RadioDriver(), threading.Event()
            internals.forget_dead_dongle(TWO[0])
            driver.connect(TWO[0], None, lambda message: None)
            internals.count_answers(driver, lambda answer, event=answered: answer and event.set())
            assert answered.wait(20.0)
            dongle = internals.dongle_thread(TWO[0])
            port.unplug()
            driver.close()
            until(lambda dongle=dongle: dongle._radio is None)
            internals.forget_dead_dongle(TWO[0])
            with pytest.raises(Exception, match="Cannot find"):
                RadioDriver().connect(TWO[0], None, lambda message: None)
            port.plug_in()
