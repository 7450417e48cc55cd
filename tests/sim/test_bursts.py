"""A radio that fails by bursts: their share, their length, and what they do to packets."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.faults.edges import FaultyRadio
from perchctl.link import Packet, Radio
from perchctl.link.mock import TELEMETRY_DELAY_S
from perchctl.sim import Scenario, radio_bursts
from perchctl.sim.bursts import CONNECTED_S, Bursts

STEP_S = 0.005
PACKET = Packet(7, 0, b"\x07")


def lengths_s(bursts: Bursts, until_s: float) -> list[float]:
    """Of the bursts, as packets every 5 ms find them."""
    found, run = [], 0
    for step in range(round(until_s / STEP_S)):
        if bursts.lost(step * STEP_S):
            run += 1
        elif run:
            found.append(run * STEP_S)
            run = 0
    return found


@pytest.mark.parametrize(("share", "mean_s"), [(0.03, 0.1), (0.2, 0.3)])
def test_share_and_length_are_what_is_asked_for(share: float, mean_s: float) -> None:
    until_s = 2000.0
    lost = lengths_s(Bursts(3, share, mean_s, 0.0), until_s)
    spread = 4.0 / math.sqrt(len(lost))
    assert sum(lost) / until_s == pytest.approx(share, rel=1.5 * spread)
    assert sum(lost) / len(lost) == pytest.approx(mean_s, rel=spread + STEP_S / mean_s)
    # Not all alike: as many are longer than twice the mean as an exponential has.
    long = sum(length_s > 2.0 * mean_s for length_s in lost) / len(lost)
    assert long == pytest.approx(math.exp(-2.0), rel=0.35)


def test_they_do_not_depend_on_how_often_is_asked() -> None:
    often, seldom = Bursts(5, 0.1, 0.2), Bursts(5, 0.1, 0.2)
    answers = [often.lost(step * STEP_S) for step in range(8000)]
    assert answers[::40] == [seldom.lost(step * STEP_S) for step in range(0, 8000, 40)]


def test_nothing_is_lost_before_the_take_off_nor_without_a_share() -> None:
    bursts = Bursts(1, 0.5, 0.5)
    assert not any(bursts.lost(step * STEP_S) for step in range(int(CONNECTED_S / STEP_S)))
    none = Bursts(1, 0.0, 0.1)
    assert not none.lost(1e6)
    assert none.newest is None


def test_both_directions_are_lost_together() -> None:
    scenario = Scenario(seed=2, radio_loss=0.3, radio_burst_s=0.3)
    radio, same = Radio(radio_bursts(scenario)), Bursts(2, 0.3, 0.3)
    assert radio_bursts(Scenario()) is None
    for step in range(4000):
        t_s = step * STEP_S
        lost = same.lost(t_s)
        assert radio.up(PACKET, t_s) is not lost
        assert radio.down("fast", t_s) == (None if lost else TELEMETRY_DELAY_S)


def test_faults_are_laid_over_the_same_radio() -> None:
    scenario = Scenario(seed=2, radio_loss=0.3, radio_burst_s=0.3)
    plain = Radio(radio_bursts(scenario))
    faulty = FaultyRadio(Radio(radio_bursts(scenario)))
    for step in range(2000):
        t_s = step * STEP_S
        assert faulty.up(PACKET, t_s) is plain.up(PACKET, t_s)
        assert faulty.down("fast", t_s) == plain.down("fast", t_s)
    faulty.cut = True
    assert not faulty.up(PACKET, 11.0)
