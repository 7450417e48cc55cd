"""`perchctl fit-weights`: fit the merge weights, and collect the data for it."""

from __future__ import annotations

import time
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import calibration as calibrations
from perchctl import camera as cameras
from perchctl import positioning as positionings
from perchctl import profile as profiles
from perchctl import vision as visions
from perchctl import weights
from perchctl.commands.command_line import (
    ForceOption,
    Group,
    JsonOption,
    ProfileOption,
    SourceOption,
    command,
    new_app,
)
from perchctl.commands.output import add_problem, ask, print_result, say, say_on_terminal
from perchctl.errors import PerchError, UsageError
from perchctl.files import check_output, same_file

app = new_app(Group)


@command(
    app,
    "perchctl fit-weights session.csv",
    "perchctl fit-weights session.csv --test other.csv",
    "perchctl fit-weights session.csv -o weights.yaml --method lms",
)
def fit(
    data: Annotated[
        Path, typer.Argument(help="CSV file, in the format that fit-weights collect writes.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Weights file to write.")
    ] = None,
    test: Annotated[
        Path | None, typer.Option("--test", help="Also test the weights on this second data set.")
    ] = None,
    method: Annotated[
        Literal["closed_form", "lms"],
        typer.Option("--method", help="Closed-form least squares, or the paper's LMS algorithm."),
    ] = "closed_form",
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Write the weights even if they are not recommended.")
    ] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> int:
    """Using ground truth, fit weights that merge both markers' poses, and verify that they help.

    Each CSV row describes one image. The columns are position (a number that identifies the
    place), t_s, and x_m, y_m, z_m and yaw_rad with each of the prefixes large_, small_ and
    actual_. If a marker was not detected in an image, its columns are empty in that row. All three
    poses are in the same coordinate frame; fit-weights collect writes the target's pose relative to
    the gear, in the level frame.
    """
    if output is not None:
        if same_file(output, data):
            raise UsageError(f"{output} is the data file itself; write the result to another file")
        check_output(output, (".yaml", ".yml"), force)
    say_on_terminal(f"reading {data}")
    result = weights.fit_weights(data, method, test)
    if not as_json:
        print(weights.report_text(result), flush=True)
    problem: PerchError | None = None
    if output is None:
        say("no file written: name one with -o")
    elif any(result.is_proven_better) or anyway:
        date = datetime.now(UTC).isoformat(timespec="seconds")
        weights.write_weights(output, result, date, anyway=anyway)
        say(
            f"weights: {output}; to fly with them, set merge.method: weights and merge.weights_file"
        )
    else:
        problem = PerchError(
            f"{output} was not written: the weights do not beat the better single marker "
            "by more than the confidence interval on any axis; record more positions, or add "
            "--anyway to write them regardless"
        )
        say(str(problem))
    if as_json:
        written = None if problem or output is None else str(output)
        print_result(
            add_problem(weights.weights_record(result) | {"weights_file": written}, problem)
        )
    return 0 if problem is None else problem.exit_code


# --- collect ---


@command(
    app,
    "perchctl fit-weights collect session.csv -p sim --truth sim",
    "perchctl fit-weights collect session.csv -p my_vehicle.yaml",
    "perchctl fit-weights collect session.csv -p lab.yaml --truth mocap",
)
def collect(
    session: Annotated[
        Path, typer.Argument(help="CSV file to write, or an unfinished one to continue.")
    ],
    profile: ProfileOption = "sim",
    truth: Annotated[
        Literal["typed", "mocap", "sim"],
        typer.Option("--truth", help="Source of the ground truth."),
    ] = "typed",
    positions: Annotated[int, typer.Option("--positions", min=2, help="Number of positions.")] = 10,
    frames: Annotated[int, typer.Option("--frames", min=10, help="Images per position.")] = 100,
    source: SourceOption = None,
    target_body: Annotated[
        str,
        typer.Option("--target-body", help="Name of the target's rigid body, for --truth mocap."),
    ] = "target",
    seed: Annotated[
        int, typer.Option("--seed", min=0, help="Seed of the positions, for --truth sim.")
    ] = 0,
) -> None:
    """Collect the data for a fit: poses of both markers at positions with known ground truth.

    Place the camera at each position and type in its actual pose. With --truth mocap, the profile's
    motion-capture system measures the actual pose. With --truth sim, the simulator places the
    camera at seeded positions. To continue a stopped session, run the same command again.
    """
    say_on_terminal(f"reading profile {profile}")
    config = profiles.load_profile(profile, with_weights=False)
    camera = calibrations.profile_camera(config.camera)
    if truth == "sim":
        _collect_simulated(session, config, camera, positions, frames, seed)
    else:
        poses = weights.TypedPoses() if truth == "typed" else _open_capture(config, target_body)
        with closing(poses):
            _collect_with_person(session, config, camera, positions, frames, poses, source)
    say(
        f"{session} is complete; now fit the weights: perchctl fit-weights {session} "
        "-o weights.yaml"
    )


def _open_session(path: Path, frames: int) -> weights.SessionFile:
    session = weights.SessionFile(path, frames)
    if session.note:
        say(session.note)
    if session.done:
        say(f"{session.path} already contains {session.done} positions")
    return session


def _collect_simulated(
    path: Path,
    profile: profiles.Profile,
    camera: visions.CameraModel,
    positions: int,
    frames: int,
    seed: int,
) -> None:
    from perchctl.commands.progress import count_bar
    from perchctl.weights import SimulatedStand

    session = _open_session(path, frames)
    with count_bar("frames", max(0, positions - session.done) * frames) as advance:
        SimulatedStand(profile, camera, positions, seed).fill_session(session, frames, advance)


def _collect_with_person(
    path: Path,
    profile: profiles.Profile,
    camera: visions.CameraModel,
    positions: int,
    frames: int,
    poses: weights.TypedPoses | weights.MocapPoses,
    source: str | None,
) -> None:
    spec = profile.camera.source if source is None else source
    if spec.startswith("sim:"):
        raise UsageError(
            "the simulator knows the ground truth: add --truth sim, or name a real camera "
            "with --source (camera:N, http://..., aideck://HOST)"
        )
    from perchctl.commands.progress import count_bar

    opened = cameras.open_camera(spec, time.monotonic, profile.camera, size_px=camera.size_px)
    with closing(opened) as frame_source:
        experiment = weights.Experiment(
            _open_session(path, frames),
            frame_source,
            profile,
            camera,
            poses,
            ask=ask,
            say=say,
            bar=count_bar,
            now=time.monotonic,
            wait=time.sleep,
        )
        experiment.run(positions, frames)


def _open_capture(profile: profiles.Profile, target_body: str) -> weights.MocapPoses:
    """Connect to the profile's motion-capture system and return it. Errors: UsageError, and the
    errors of `open_capture`."""
    if not profile.positioning.source.is_mocap:
        raise UsageError(
            "--truth mocap needs a profile with motion capture, as in "
            "positioning: {by: mocap, system: vicon, host: 192.168.1.2, body: cf}"
        )
    import numpy as np

    gear = np.asarray(profile.vehicle.gear_body_m, dtype=np.float64)
    return weights.MocapPoses(
        positionings.open_capture(profile.positioning), profile.positioning, target_body, gear
    )
