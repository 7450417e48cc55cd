"""`perchctl fit-weights`: fit the merge weights, and collect the data for it."""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from perchctl.calibration import profile_camera
from perchctl.camera import open_camera
from perchctl.commands.command_line import (
    Command,
    ForceOption,
    Group,
    JsonOption,
    ProfileOption,
    examples,
    new_app,
    reporting,
)
from perchctl.commands.output import print_record, say
from perchctl.commands.progress import count_bar
from perchctl.errors import (
    Interrupted,
    InvalidValue,
    NotFound,
    PerchError,
    UsageError,
    no_simulator,
)
from perchctl.files import check_output, same_file, write_files
from perchctl.places import data_folder, user_config_folder
from perchctl.profile import Profile, find_weights, load_profile
from perchctl.vision import CameraModel
from perchctl.weights import (
    FITTED,
    EstimateTruth,
    Experiment,
    LmsOptions,
    MocapTruth,
    SessionFile,
    TypedTruth,
    fit_weights,
    four_numbers,
    open_named,
    report_text,
    weights_record,
    write_weights,
)

app = new_app(Group)


def _grouped(panel: str, *names: str, **settings: Any) -> Any:
    return typer.Option(*names, rich_help_panel=panel, **settings)


@app.command(
    cls=Command,
    epilog=examples(
        "perchctl fit-weights session.csv -p sim",
        "perchctl fit-weights session.csv --test other.csv --plot weights.png",
        "perchctl fit-weights session.csv -o weights.yaml --method lms",
    ),
)
@reporting
def fit(
    data: Annotated[
        list[Path] | None, typer.Argument(help="CSV files, as fit-weights collect writes them.")
    ] = None,
    profile: ProfileOption = "sim",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Weights file; else the profile's.")
    ] = None,
    test: Annotated[
        Path | None, typer.Option("--test", help="Judge the weights on this other data too.")
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the evidence (.png).")] = None,
    method: Annotated[
        str,
        typer.Option("--method", help="closed_form, lms, nlms or inverse_variance: to be used."),
    ] = "closed_form",
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Write weights that are not recommended, too.")
    ] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
    step: Annotated[
        float | None,
        _grouped("LMS", "--step", help="Constant step, in 1 / mean(d^2); else it falls."),
    ] = None,
    passes: Annotated[
        int | None, _grouped("LMS", "--passes", help="Times through the data.")
    ] = None,
    order: Annotated[
        Literal["shuffled", "recorded"], _grouped("LMS", "--order", help="Of the rows.")
    ] = "shuffled",
    start: Annotated[float, _grouped("LMS", "--start", help="First weight.")] = 0.5,
) -> int:
    """Fit the merge weights to poses whose truth is known, and verify that they help.

    A CSV row is a frame: position (a number for the place), t_s, then x_m, y_m, z_m and yaw_rad
    of large_, small_ and actual_; the cells of a marker that was not seen are empty. joint_
    columns may follow. All three poses are in one frame; collect writes the target relative to
    the gear in the level frame.
    """
    files = tuple(data or ())
    if method not in FITTED:
        raise InvalidValue(f"--method {method!r} is unknown; allowed are {', '.join(FITTED)}")
    for written, suffixes in ((output, (".yaml", ".yml")), (plot, (".png",))):
        if written is None:
            continue
        if any(same_file(written, file) for file in files):
            raise UsageError(f"{written} is the data itself; write the result to another file")
        check_output(written, suffixes, force)
    # The weights file may not be there yet: this command makes it.
    config = load_profile(profile, with_weights=False)
    with count_bar("fitting", None):
        result = fit_weights(
            files, LmsOptions(step, passes, order == "shuffled", start), method, test
        )
    if not as_json:
        print(report_text(result), flush=True)
    drawn: Path | None = None
    file: Path | None = None
    problem: PerchError | None = None
    try:
        if plot is not None:
            from perchctl.weights import draw_weights  # matplotlib takes a second to load

            write_files({plot: draw_weights(result)})
            drawn = plot
            say(f"plot: {plot}")
        file = _place_for_weights(config, output, any(result.proven), anyway, force)
        if file is not None:
            date = datetime.now(UTC).isoformat(timespec="seconds")
            write_weights(file, result, date, anyway=anyway)
            say(f"weights: {file}")
            if config.merge.method != "weights":
                say(
                    f"profile {config.name} merges by {config.merge.method}: these weights fly "
                    f"with merge.method: weights and merge.weights_file: {file.name}"
                )
    except (PerchError, KeyboardInterrupt) as error:
        # The weights are known, and are printed whatever fails beside them.
        problem = error if isinstance(error, PerchError) else Interrupted("Ctrl-C: nothing written")
        say(str(problem))
    code = 0 if problem is None else problem.exit_code
    if as_json:
        paths = {"weights_file": file and str(file), "plot": drawn and str(drawn)}
        failure = {} if problem is None else {"error": str(problem), "exit_code": code}
        print_record(weights_record(result) | paths | failure)
    return code


def _place_for_weights(
    profile: Profile, output: Path | None, recommended: bool, anyway: bool, force: bool
) -> Path | None:
    """Where the weights are to be written: `-o`, else the profile's file; None, with a sentence,
    where they are not. Raises PerchError where `-o` names a file, and they are not recommended."""
    place = output or _profile_file(profile)
    if place is None:
        say(
            "no file written: name one with -o, or in the profile (merge.weights_file)"
            if recommended
            else "no file written: the weights are not recommended"
        )
        return None
    if place.exists() and not force:
        say(f"{place} exists already and stays as it is; add --force to replace it")
        return None
    if recommended or anyway:
        return place
    sentence = (
        f"{place} not written: on no axis do the weights beat the better single marker beyond "
        f"the interval; take more positions, or write them all the same with --anyway"
    )
    if output is not None:
        raise PerchError(sentence)
    say(sentence)
    return None


def _profile_file(profile: Profile) -> Path | None:
    """Where the profile's weights file is, or shall be."""
    name = profile.merge.weights_file
    if name is None:
        return None
    try:
        return find_weights(name)
    except NotFound:
        missing = Path(name)
        if missing.parent == data_folder("profiles").resolve():
            return user_config_folder() / "weights" / missing.name
        return missing


# --- collect -----------------------------------------------------------------------------------


VEHICLE, TARGET = "cf", "target"
"""Rigid bodies that nobody has named."""


@app.command(
    cls=Command,
    epilog=examples(
        "perchctl fit-weights collect session.csv -p sim --truth sim",
        "perchctl fit-weights collect session.csv -p my_vehicle.yaml",
        "perchctl fit-weights collect session.csv -p my_vehicle.yaml --truth mocap",
    ),
)
@reporting
def collect(
    session: Annotated[Path, typer.Argument(help="The CSV; an unfinished one goes on.")],
    profile: ProfileOption = "sim",
    truth: Annotated[
        Literal["typed", "mocap", "estimate", "sim"],
        typer.Option("--truth", help="Where the actual pose comes from."),
    ] = "typed",
    positions: Annotated[int, typer.Option("--positions", min=2, help="To collect.")] = 10,
    frames: Annotated[int, typer.Option("--frames", min=10, help="At each position.")] = 100,
    source: Annotated[
        str | None,
        typer.Option("--source", help="Camera; else the profile's."),
    ] = None,
    uri: Annotated[
        str | None, _grouped("Truth", "--uri", "-u", help="Vehicle, for --truth estimate.")
    ] = None,
    mocap: Annotated[
        str | None,
        _grouped(
            "Truth", "--mocap", help="TYPE:HOST, as in vicon:192.168.1.2; else the profile's."
        ),
    ] = None,
    bodies: Annotated[
        str | None,
        _grouped(
            "Truth",
            "--bodies",
            help="Rigid bodies of vehicle and target; else the profile's, and target.",
        ),
    ] = None,
    target: Annotated[
        str | None,
        _grouped("Truth", "--target", help="Target in the world, 'x y z yaw' in m and deg."),
    ] = None,
    seed: Annotated[int, _grouped("Simulation", "--seed", min=0, help="Of the places.")] = 0,
    noise: Annotated[
        float, _grouped("Simulation", "--noise", min=0.0, max=50.0, help="Grey levels.")
    ] = 4.0,
    blur: Annotated[
        float, _grouped("Simulation", "--blur", min=0.0, max=50.0, help="Sigma in px.")
    ] = 1.0,
) -> int:
    """Collect the data of a fit: poses of both markers at places whose actual pose is known.

    A person places the camera, and gives the actual pose; with --truth sim the simulator's camera
    stands at seeded places. A session that was stopped goes on with the same command.
    """
    config = load_profile(profile, with_weights=False)
    camera = profile_camera(config.camera)
    if truth == "sim":
        _collect_simulated(session, config, camera, positions, frames, seed, noise, blur)
    else:
        _collect_with_person(session, config, camera, positions, frames, truth, source,
                             mocap=mocap, bodies=bodies, target=target, uri=uri)  # fmt: skip
    say(f"{session} is complete: perchctl fit-weights {session} -p {profile} fits the weights")
    return 0


def _open_session(path: Path, frames: int) -> SessionFile:
    session = SessionFile(path, frames)
    if session.note:
        say(session.note)
    if session.done:
        say(f"{session.path} holds {len(session.done)} positions already")
    return session


def _collect_simulated(
    path: Path,
    profile: Profile,
    camera: CameraModel,
    positions: int,
    frames: int,
    seed: int,
    noise: float,
    blur: float,
) -> None:
    try:
        from perchctl.weights import SimulatedStand
    except ImportError as error:
        raise no_simulator(error.name) from None

    session = _open_session(path, frames)
    stand = SimulatedStand(profile, camera, positions, seed, noise, blur)
    left = max(0, positions - len(session.done))
    with count_bar("frames", left * frames) as advance:
        stand.fill(session, left, frames, advance)


def _collect_with_person(
    path: Path,
    profile: Profile,
    camera: CameraModel,
    positions: int,
    frames: int,
    truth: str,
    source: str | None,
    **given: str | None,
) -> None:
    """`given`: the options of the truth."""
    start_s = time.monotonic()

    def now() -> float:
        return time.monotonic() - start_s

    spec = profile.camera.source if source is None else source
    if spec.startswith("sim:"):
        raise UsageError(
            "the simulator has the truth itself: add --truth sim, or name a real camera "
            "with --source (camera:N, http://..., aideck://HOST)"
        )
    with ExitStack() as stack:
        poses = _open_truth(truth, profile, **given)
        stack.callback(poses.close)
        frame_source = open_camera(spec, now, profile.camera, size_px=camera.size_px)
        stack.callback(frame_source.close)
        experiment = Experiment(
            _open_session(path, frames), frame_source, profile, camera, poses,
            ask=_ask, say=say, bar=count_bar, now=now, wait=time.sleep,
        )  # fmt: skip
        experiment.run(positions, frames)


def _open_truth(
    truth: str,
    profile: Profile,
    mocap: str | None = None,
    bodies: str | None = None,
    target: str | None = None,
    uri: str | None = None,
) -> TypedTruth | MocapTruth | EstimateTruth:
    """The source of the actual poses, connected. Errors: UsageError, those of connecting."""
    gear = np.asarray(profile.vehicle.gear_body_m, dtype=np.float64)
    place = None if target is None else four_numbers(target)
    if truth == "typed":
        return TypedTruth()
    if truth == "estimate":
        from perchctl.link import EstimateLink

        link = EstimateLink(uri or profile.link.uri, profile.link, time.monotonic)
        link.connect()
        return EstimateTruth(link.telemetry, place, gear, link.close)
    own = profile.positioning if profile.positioning.by == "mocap" else None
    if mocap is None and own is not None:
        mocap = f"{own.system}:{own.host}"
    if mocap is None or not mocap.partition(":")[2].strip():
        raise UsageError(
            "--truth mocap needs --mocap TYPE:HOST, as in vicon:192.168.1.2, or a profile with "
            "positioning: {by: mocap, system: vicon, host: 192.168.1.2}"
        )
    body, aim = (VEHICLE if own is None else own.body), TARGET
    if bodies is not None:
        body, _, aim = bodies.partition(",")
    capture = open_named(mocap, body)
    return MocapTruth(capture, mocap, body, aim if place is None else place, gear, own)


def _ask(question: str) -> str:
    """On stderr, as stdout is for the result. Raises EOFError at the end of the input."""
    print(question, end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        raise EOFError
    return line.rstrip("\n")
