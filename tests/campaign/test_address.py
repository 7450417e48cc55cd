"""`--cluster ADDRESS`: its forms, and what it goes together with."""

from __future__ import annotations

import importlib.util
import socket
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")


from perchctl.campaign.pool import ClusterAddress, parse_address
from perchctl.errors import UsageError
from tests.helpers.commands import elsewhere, run  # noqa: F401
from tests.helpers.flights import SHORT


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("local:1", ClusterAddress(None, 1)),
        ("local:64", ClusterAddress(None, 64)),
        ("tcp://10.0.0.5:8786", ClusterAddress("tcp://10.0.0.5:8786")),
        ("node7.lab:8786", ClusterAddress("tcp://node7.lab:8786")),
        ("tls://[::1]:8786", ClusterAddress("tls://[::1]:8786")),
    ],
)
def test_an_address_is_read(text: str, place: ClusterAddress) -> None:
    assert parse_address(text) == place
    assert parse_address(str(place)) == place


@pytest.mark.parametrize(
    "text",
    [
        "", "local", "local:", "local:0", "local:1025", "local:-1", "local:2.5", "local:\u00b2",
        "localhost", "10.0.0.5", "tcp://10.0.0.5", "http://10.0.0.5:8786", "10.0.0.5:0",
        "10.0.0.5:65536", "a b:8786", "local:" + 5000 * "9",
    ],
)  # fmt: skip
def test_what_is_none_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"must be .* as in --cluster"):
        parse_address(text)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--jobs", "2"), "--jobs 2 does not apply"),
        (("--only", "3"), "--cluster local:2 does not apply; leave it out, or --only"),
        (("--faults", "list"), "--cluster local:2 does not apply"),
        (("sweep", "planner.attempts=1", "--jobs", "1"), "--jobs 1 does not apply"),
    ],
)
def test_what_does_not_go_with_it_is_refused(words: tuple[str, ...], named: str) -> None:
    said = run("simulate", *words, "--cluster", "local:2")
    assert said.code == UsageError.exit_code
    assert named in said.stderr


def test_without_the_library_one_sentence_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    there = importlib.util.find_spec
    hide = lambda name, *rest: None if name == "distributed" else there(name, *rest)  # noqa: E731
    monkeypatch.setattr("perchctl.commands.simulate.find_spec", hide)
    said = run("simulate", "-p", SHORT, "-n", "2", "--cluster", "local:2")
    assert said.code == 2
    assert said.complaint.startswith("--cluster needs the library distributed (it is missing)")
    assert said.complaint.endswith("-m pip install 'perchctl[cluster]'")


def test_an_address_that_nobody_answers_is_told_in_time(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("distributed", reason="clusters need the extra [cluster]")
    monkeypatch.setattr("perchctl.campaign.cluster.ANSWER_S", 0.3)
    with socket.socket() as deaf:  # is bound, and takes no call
        deaf.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{deaf.getsockname()[1]}"
        said = run(
            "simulate", "-p", SHORT, "-n", "2", "--cluster", address, "--log-dir", str(tmp_path)
        )
    assert said.code == 10
    assert said.stdout == ""
    assert said.complaint.startswith(f"no dask scheduler answers at tcp://{address} within")
    assert said.complaint.endswith("start dask scheduler there, or mend the address")
    assert list(tmp_path.iterdir()) == []
