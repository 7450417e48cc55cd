"""Who flies a seed changes nothing of it."""

from __future__ import annotations

from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
pytest.importorskip("distributed", reason="clusters need the extra [cluster]")

from perchctl.campaign import (
    FlightResult,
    cluster_pool,
    flight_processes,
    fly_all,
    parse_address,
    run_campaign,
)
from perchctl.campaign.results_file import flown_record
from perchctl.profile import load_profile
from tests.helpers.cluster import dies_in_flight

pytestmark = pytest.mark.campaign

SEEDS = range(40)
DEADLY = (7, 23)
"""Their first flights lose the worker, on the way up."""


def test_forty_seeds_in_one_process_in_two_and_on_a_cluster(tmp_path: Path) -> None:
    profile = load_profile("sim")

    def flown(executor: Executor) -> list[dict[str, Any]]:
        return [flown_record(result) for result in run_campaign(profile, SEEDS, executor)]

    with flight_processes(1) as one:
        alone = flown(one)
    assert [record["seed"] for record in alone] == list(SEEDS)
    with flight_processes(2) as two:
        assert flown(two) == alone
    told: list[FlightResult] = []
    fly = partial(dies_in_flight, profile, tmp_path, DEADLY)
    with cluster_pool(parse_address("local:2"), [profile]) as pool:
        results = fly_all(fly, SEEDS, pool, told.append)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(map(str, DEADLY))
    assert [flown_record(result) for result in results] == alone
    assert sorted(result.seed for result in told) == list(SEEDS)
