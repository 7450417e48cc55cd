"""What each vehicle's process is given before it starts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import pytest

from perchctl.corridor import Corridor
from perchctl.errors import ConnectionFailed
from perchctl.fleet import flight_options, load_fleet, make_plan, open_radios, prepare
from perchctl.fleet.fleet import Fleet
from perchctl.link import HubReport
from tests.fleet.rig import fleet, on_air, same_channel

NORTH, EAST = "radio://0/80/2M/E7E7E7E701", "radio://1/84/2M/E7E7E7E702"


@pytest.mark.parametrize(
    "planned",
    [
        load_fleet(),
        fleet([((1.0, 2.0), (1.5, 2.0)), ((5.0, 2.0), (5.0, 2.5))]),
        on_air([NORTH, EAST]),
    ],
    ids=["deck", "simulated-capture", "real-in-the-room"],
)
def test_each_flies_by_its_corridor_in_its_own_axes(planned: Fleet, tmp_path: Path) -> None:
    plan = make_plan(planned)
    for name, options in flight_options(plan, tmp_path, 0, None).items():
        vehicle, safety = plan.fleet.vehicle(name).as_flown, options.profile.safety
        assert safety.corridor is not None
        corridor = Corridor(**dict(safety.corridor))
        assert corridor.radius_m == plan.corridors[name].radius_m
        assert corridor.contains(*vehicle.to_estimate(vehicle.home_m), 0.0)
        assert options.profile.target.expected_xy_m == corridor.target_m
        assert corridor.contains(*corridor.target_m, corridor.target_top_m)
        if options.simulated:
            assert (corridor.home_m, options.sim_target_xy_m) == ((0.0, 0.0), corridor.target_m)
        else:
            assert (corridor.home_m, options.uri) == (vehicle.home_m, vehicle.uri)


# --- Shared dongles ---


class FakeHub:
    """Stands for a `RadioHub`; `made` are all of them."""

    made: list[FakeHub]

    def __init__(self, given: Sequence[str]) -> None:
        if len(self.made) == 2:
            raise ConnectionFailed("the Crazyradio cannot be opened")
        self.made.append(self)
        self.uris = {uri: f"hub://127.0.0.1:{9000 + n}" for n, uri in enumerate(given)}
        self.reports: dict[str, HubReport] = {}
        self.problem: str | None = None
        self.is_open = True
        self.limits: list[tuple[str, int | None]] = []

    def limit(self, uri: str, packets_per_s: int | None) -> None:
        self.limits.append((uri, packets_per_s))

    def update(self) -> str | None:
        return self.problem

    def __enter__(self) -> FakeHub:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: object, trace: TracebackType | None
    ) -> None:
        self.is_open = False


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[FakeHub]:
    monkeypatch.setattr(FakeHub, "made", [], raising=False)
    monkeypatch.setattr(prepare, "RadioHub", FakeHub)
    return FakeHub.made


def test_those_who_share_a_dongle_fly_through_its_hub(made: list[FakeHub], tmp_path: Path) -> None:
    plan = make_plan(on_air([NORTH, NORTH.replace("01", "03"), EAST]))
    options = flight_options(plan, tmp_path, 0, None)
    with open_radios(plan) as radios:
        (hub,) = made
        routed = radios.route(options)
        assert [each.link_uri for each in routed.values()] == [*hub.uris.values(), None]
        assert [each.uri for each in routed.values()] == [each.uri for each in options.values()]
        assert hub.is_open
        radios.slow_down(NORTH)
        radios.slow_down(EAST)
        assert hub.limits == [(NORTH, prepare.IDLE_PER_S)]
    assert not hub.is_open


def test_a_problem_of_a_hub_or_of_its_dongle_is_named(made: list[FakeHub]) -> None:
    with open_radios(make_plan(same_channel(2))) as radios:
        (hub,) = made
        assert radios.problems() == {}
        hub.reports = {uri: HubReport(problem="it is dead") for uri in hub.uris}
        assert radios.problems() == {"0": "it is dead"}
        hub.problem = "the radio hub has stopped"
        assert radios.problems() == {"0": "the radio hub has stopped"}


def test_a_dongle_that_does_not_open_is_named_and_the_others_are_closed(
    made: list[FakeHub],
) -> None:
    six = [f"radio://{n // 2}/{80 + 4 * (n // 2)}/2M/E7E7E7E70{n}" for n in range(6)]
    with (
        pytest.raises(ConnectionFailed, match=r"^dongle 2: the Crazyradio cannot be opened"),
        open_radios(make_plan(on_air(six))),
    ):
        pass
    assert [hub.is_open for hub in made] == [False, False]
