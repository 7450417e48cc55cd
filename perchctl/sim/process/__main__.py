"""`python -m perchctl.sim.process --port 19850`: a simulated vehicle in the foreground."""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
from collections.abc import Sequence

from perchctl.calibration import load_calibration
from perchctl.errors import PerchError
from perchctl.places import data_file
from perchctl.sim.capture import COMMAND_PORT, CaptureSettings
from perchctl.sim.process.child import Runner
from perchctl.sim.process.handle import HostSetup
from perchctl.sim.process.host import VehicleHost
from perchctl.sim.scenario import Scenario


def main(arguments: Sequence[str] | None = None) -> int:
    """A simulated vehicle in the foreground, in real time, until Ctrl-C."""
    parser = argparse.ArgumentParser(
        prog="python -m perchctl.sim.process",
        description="A simulated Crazyflie on udp://, its camera on http://, until Ctrl-C.",
    )
    parser.add_argument("--port", type=int, default=19850, help="UDP port of the vehicle")
    parser.add_argument("--http-port", type=int, default=8080, help="port of the camera's stream")
    parser.add_argument(
        "--capture",
        action="store_true",
        help=f"no deck; motion capture on 127.0.0.1:{COMMAND_PORT}, as OptiTrack's",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of noise and drops")
    options = parser.parse_args(arguments)

    calibration = data_file("calib", "example_640x480")
    setup = HostSetup(
        scenario=Scenario(
            seed=options.seed, extra={"external_position": 1.0} if options.capture else {}
        ),
        capture=CaptureSettings(seed=options.seed) if options.capture else None,
        camera=load_calibration(calibration) if calibration is not None else None,
        port=options.port,
        http_port=options.http_port,
        capture_port=COMMAND_PORT if options.capture else 0,
    )
    # A shell starts what runs in its background with Ctrl-C ignored, and children inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        host = VehicleHost(setup, live=True)
    except PerchError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    with contextlib.closing(host):
        stream = host.stream.url if host.stream is not None else "none"
        positions = " ".join(host.capture or ("none",))
        print(
            f"vehicle {host.uri}\ncamera  {stream}\ncapture {positions}\nCtrl-C ends it",
            flush=True,
        )
        with contextlib.suppress(KeyboardInterrupt):
            Runner(host, None, realtime=True, linger_s=0.0).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
