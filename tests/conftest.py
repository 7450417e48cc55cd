"""Slow modules first: a module is one worker's work, and the last one begun ends the run.

Examples are drawn the same in each run, no time decides a test, and no test sees what this
computer has or what its user has set.
"""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator

import pytest
from hypothesis import settings

settings.register_profile("repeatable", max_examples=50, deadline=None, derandomize=True)
settings.load_profile("repeatable")

# One core for each worker and for each process that a test starts: threads of BLAS and OpenCV that
# wait for a core of another worker take up to three times the processor's time.
for _name in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_name, "1")

# By these somebody's shell, or a service that runs tests, asks for colours, another width, or
# another vehicle. Libraries read some of them as they are loaded.
for _name in ("CFLIB_URI", "COLUMNS", "FORCE_COLOR", "GITHUB_ACTIONS", "NO_COLOR", "PY_COLORS"):
    os.environ.pop(_name, None)

# What tests start gets its signals as from a terminal, also where nohup or a background shell
# started the tests with some of them ignored, which children inherit.
for _name in ("SIGINT", "SIGHUP", "SIGQUIT", "SIGTSTP"):
    _number = getattr(signal, _name, None)
    if _number is not None and signal.getsignal(_number) is signal.SIG_IGN:
        _usual = signal.default_int_handler if _name == "SIGINT" else signal.SIG_DFL
        signal.signal(_number, _usual)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--as-recorded",
        action="store_true",
        help="take each log for one of this computer, whatever its header says: no test may care",
    )


@pytest.fixture(scope="session", autouse=True)
def _as_recorded(request: pytest.FixtureRequest) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        if request.config.getoption("--as-recorded"):
            from perchctl.record import FlightLog

            patch.setattr(FlightLog, "computer_differences", "")
        yield


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One more than cores: some tests wait for a radio, a camera or another process."""
    return len(os.sched_getaffinity(0)) + 1 if hasattr(os, "sched_getaffinity") else 2


gc.disable()  # until all is loaded, of which hardly anything is garbage


def pytest_collection_finish() -> None:
    """What has been loaded by now stays to the end: no collection of garbage looks through it."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _own_folders(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Of its own for each worker: two that name the same address must not meet there, and what
    tests compare is no word on the user's motion capture."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("runtime")))
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_radio() -> Iterator[None]:
    """A Crazyradio or a Crazyflie on USB that is plugged into this computer is nobody's here."""
    from cflib.drivers import cfusb, crazyradio

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(crazyradio, "_find_devices", lambda serial=None: [])
        patch.setattr(cfusb, "_find_devices", lambda: [])
        yield


SLOW_FIRST = (
    "flight/test_flights.py",
    "test_docs.py",
    "sim/test_crtp_flight.py",
    "test_fly_command.py",
    "flight/test_loop.py",
    "flight/test_loop_breaks.py",
    "mission/test_way_down.py",
    "flight/test_outside.py",
    "vision/test_gate.py",
    "calibration/test_mounting_solve.py",
    "sim/test_crtp_supervisor.py",
    "sim/test_crtp_ceiling.py",
    "replay/test_planner.py",
    "calibration/test_mount_live.py",
    "link/test_radio.py",
    "test_library.py",
    "mission/test_abort_matrix.py",
    "target/test_sight.py",
    "vision/test_fields.py",
    # With the long tests:
    "flight/test_realtime.py",
    "target/test_make_target.py",
    "link/test_cflib_link.py",
    "calibration/test_calibration_command.py",
    "calibration/test_calibration_live.py",
    "faults/test_flights.py",
    "sim/test_crtp_process.py",
    "sim/test_crtp_link.py",
    "weights/test_command.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """In the order above, then as collected."""

    def place(item: pytest.Item) -> int:
        path = item.path.as_posix()
        return next(
            (i for i, name in enumerate(SLOW_FIRST) if path.endswith(name)), len(SLOW_FIRST)
        )

    items.sort(key=place)
