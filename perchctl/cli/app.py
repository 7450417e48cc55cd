"""The command line: parse, load the profile, one call, an exit code."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from perchctl import __version__
from perchctl.errors import EXIT_CODES, Interrupted, PerchError, UsageError

EXIT_TABLE = "Exit codes:\n\n" + "\n\n".join(
    f"{code:>3}  {meaning}" for code, meaning in sorted(EXIT_CODES.items())
)

app = typer.Typer(
    name="perchctl",
    help="Hang a Crazyflie onto a ceiling by the sight of a printed target.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@contextlib.contextmanager
def reported() -> Iterator[None]:
    """Turns every failure into one sentence on stderr and its exit code."""
    try:
        yield
    except typer.Exit:
        raise
    except PerchError as error:
        print(f"perchctl: {error}", file=sys.stderr)
        raise typer.Exit(error.exit_code) from None
    except KeyboardInterrupt:
        print("perchctl: Ctrl-C", file=sys.stderr)
        raise typer.Exit(Interrupted.exit_code) from None
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(PerchError.exit_code) from None
    except Exception as error:
        if os.environ.get("PERCHCTL_DEBUG"):
            raise
        print(
            f"perchctl: unforeseen {type(error).__name__}: {error} "
            f"(PERCHCTL_DEBUG=1 shows where; please report it)",
            file=sys.stderr,
        )
        raise typer.Exit(PerchError.exit_code) from None


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"perchctl {__version__}")
        raise typer.Exit


@app.callback()
def _top(
    version: Annotated[
        bool,
        typer.Option("--version", "-V", callback=_print_version, is_eager=True, help="Version."),
    ] = False,
) -> None:
    pass


ProfileOption = Annotated[
    str, typer.Option("--profile", "-p", help="Profile by name or path.", show_default=True)
]
ViewOption = Annotated[
    bool, typer.Option("--view", help="Serve a live page on 127.0.0.1 and print its address.")
]
ViewPortOption = Annotated[
    int,
    typer.Option("--view-port", min=0, max=65535, help="Port of the live page; 0: any free one."),
]


@app.command(epilog=EXIT_TABLE)
def fly(
    profile: ProfileOption = "sim",
    uri: Annotated[
        str | None,
        typer.Option(
            "--uri",
            "-u",
            envvar="CFLIB_URI",
            help="Vehicle: sim://, radio://0/80/2M/E7E7E7E7E7, usb://0, udp://HOST:PORT.",
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--source", help="Camera: camera:N, video:FILE, images:DIR, http://..., sim:."
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the simulated scenario.")] = 0,
    log_dir: Annotated[
        Path | None, typer.Option("--log-dir", help="Folder for the flight log and its plot.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show the resolved plan; connect nothing.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask before arming.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object on stdout at the end.")
    ] = False,
    view: ViewOption = False,
    view_port: ViewPortOption = 0,
) -> None:
    """Fly the seven phases: find the target, align, ascend, perch, stop the motors.

    Without options it flies the simulated vehicle. Ctrl-C once lands, twice cuts the motors.
    """
    with reported():
        from perchctl.commands import fly as work

        options = work.resolve(profile, uri, source, seed, log_dir)
        if dry_run:
            print(work.plan_json(options) if as_json else work.plan_text(options))
            return
        if not (yes or options.simulated):
            _ask_before_arming(options.uri)
        page_port = view_port if view or view_port > 0 else None
        code = work.run(options, as_json=as_json, page_port=page_port)
        raise typer.Exit(code)


def _ask_before_arming(uri: str) -> None:
    if not sys.stdin.isatty():
        raise UsageError(f"about to arm {uri}, and there is nobody to ask: add --yes")
    answer = input(f"About to arm and fly {uri}. Is the space under the target clear? [y/N] ")
    if answer.strip().lower() not in ("y", "yes"):
        raise UsageError("not confirmed: nothing was started")


@app.command()
def simulate(
    flights: Annotated[int, typer.Option("-n", "--flights", min=1, help="How many.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first flight.")] = 0,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Flights at a time.")] = 1,
    only: Annotated[
        int | None, typer.Option("--only", min=0, help="Repeat the one flight of this seed.")
    ] = None,
    profile: ProfileOption = "sim",
    log_dir: Annotated[
        Path | None, typer.Option("--log-dir", help="Folder for the log of an --only flight.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Fly many seeded scenarios in lockstep, faster than real time, and count."""
    with reported():
        from perchctl.commands import simulate as work

        work.run(
            profile,
            seeds=[only] if only is not None else list(range(seed, seed + flights)),
            jobs=jobs,
            log_dir=log_dir if only is not None else None,
            as_json=as_json,
        )


@app.command()
def track(
    source: Annotated[
        str,
        typer.Argument(
            help="camera:N, video:FILE, images:DIR (or a pattern), http://..., or a path."
        ),
    ],
    profile: ProfileOption = "sim",
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration", help="Camera calibration (ROS, OpenCV or Kalibr); else the profile's."
        ),
    ] = None,
    stills: Annotated[
        bool, typer.Option("--stills", help="Each picture alone: no window, no filter.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON line a frame.")] = False,
    csv: Annotated[
        Path | None, typer.Option("--csv", help="Write the results as CSV, t_s first.")
    ] = None,
    overlay: Annotated[
        Path | None, typer.Option("--overlay", help="Write the pictures with results as .mp4.")
    ] = None,
    view: ViewOption = False,
    view_port: ViewPortOption = 0,
) -> None:
    """Find the target in a camera, video or pictures, without a vehicle.

    Poses are in the OpenCV camera frame with cv2.aruco's marker axes: X_cam = R(rvec) X_marker +
    tvec. A JSON line holds frame, t_s, stage (large, both, small, none), large and small (null,
    or corners_px TL TR BR BL, rvec_rad, tvec_m, reprojection_px) and target (null, or rvec_rad,
    tvec_m, yaw_rad, sigma_m, sigma_yaw_rad). With both markers in sight target is their joint
    pose; without --stills it is filtered, and goes on for a few frames after stage none.
    yaw_rad is atan2(R[1,0], R[0,0]): the marker's heading in the picture's plane. sigma_m is
    along the camera's x, y, z.
    """
    with reported():
        from perchctl.commands import track as work

        options = work.resolve(
            source,
            profile,
            calibration,
            stills=stills,
            as_json=as_json,
            csv=csv,
            overlay=overlay,
            view=view or view_port > 0,
            view_port=view_port,
        )
        work.run(options)


@app.command()
def calibrate(
    source: Annotated[
        str | None,
        typer.Argument(
            help="images:DIR (or a pattern), video:FILE, camera:N, http://..., or a path."
        ),
    ] = None,
    board: Annotated[
        str,
        typer.Option(
            "--board",
            "-b",
            help="chessboard:9x6:25mm (inner corners) or charuco:10x7:25mm:18mm:DICT_5X5_100 "
            "(squares; :legacy behind it for OpenCV's old layout).",
        ),
    ] = "charuco:10x7:25mm:18mm:DICT_5X5_100",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Calibration file; the report goes beside it as .png. "
            "Default: calib/NAME_WIDTHxHEIGHT.yaml.",
        ),
    ] = None,
    name: Annotated[str, typer.Option("--name", help="The camera's name.")] = "camera",
    model: Annotated[
        str,
        typer.Option(
            "--model", help="auto (the recommended), plumb_bob, rational_polynomial or fisheye."
        ),
    ] = "auto",
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    check: Annotated[
        Path | None,
        typer.Option("--check", help="Judge this calibration by the source's pictures instead."),
    ] = None,
    convert: Annotated[
        Path | None,
        typer.Option("--convert", help="Read an OpenCV, Kalibr or ROS file and write --output."),
    ] = None,
    reject: Annotated[
        bool, typer.Option("--reject/--no-reject", help="Leave out outlier views and corners.")
    ] = True,
    plain_corners: Annotated[
        bool, typer.Option("--plain-corners", help="OpenCV's corners, not the fitted ones.")
    ] = False,
    keep_pictures: Annotated[
        Path | None,
        typer.Option("--keep-pictures", help="Folder for the pictures taken of a live camera."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
    view: ViewOption = False,
    view_port: ViewPortOption = 0,
) -> None:
    """Calibrate the camera, and say what its error means in mm at the target.

    A view is rejected when its RMS is above 2.5 times the median view's, a corner when it is off
    by more than 5 times its view's spread; both are named. --check exits with 1 on a fail.
    """
    with reported():
        from perchctl.commands import calibrate as work

        if convert is not None:
            if source is not None or check is not None:
                raise UsageError("--convert takes a file and no source or --check")
            work.run_convert(convert, output, name, force, as_json)
            return
        if source is None:
            raise UsageError(
                "a SOURCE is needed: images:DIR (or a pattern), video:FILE, camera:N or http://..."
            )
        options = work.resolve(
            source,
            board,
            output=output,
            name=name,
            model=model,
            force=force,
            rejecting=reject,
            refine=not plain_corners,
            as_json=as_json,
            view=view,
            view_port=view_port,
            pictures=keep_pictures,
        )
        if check is None:
            work.run(options)
        elif not work.run_check(options, check):
            raise typer.Exit(PerchError.exit_code)


@app.command()
def make_target(
    profile: Annotated[
        str | None,
        typer.Option("--profile", "-p", help="Profile with the target; sim if none is named."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="PDF to write (target.pdf), or with --measured-* a new profile."
        ),
    ] = None,
    page: Annotated[
        str, typer.Option("--page", help="a4, letter, a3, or a size such as 220x240mm.")
    ] = "a4",
    large: Annotated[
        str | None, typer.Option("--large", help="Side of the large marker: 150mm, 15cm, 0.15m.")
    ] = None,
    large_id: Annotated[int | None, typer.Option("--large-id", min=0, help="Its id.")] = None,
    large_dict: Annotated[
        str | None, typer.Option("--large-dict", help="Its dictionary, such as DICT_4X4_1000.")
    ] = None,
    small: Annotated[
        str | None, typer.Option("--small", help="Side of the small marker, with its unit.")
    ] = None,
    small_id: Annotated[int | None, typer.Option("--small-id", min=0, help="Its id.")] = None,
    small_dict: Annotated[
        str | None, typer.Option("--small-dict", help="Its dictionary: DICT_ARUCO_ORIGINAL, ...")
    ] = None,
    magnet: Annotated[
        str, typer.Option("--magnet", help="Diameter of the magnet behind the sheet.")
    ] = "50mm",
    png: Annotated[
        int | None, typer.Option("--png", metavar="DPI", help="Also as PNG, at that resolution.")
    ] = None,
    svg: Annotated[bool, typer.Option("--svg", help="Also as SVG.")] = False,
    board: Annotated[
        str | None,
        typer.Option(
            "--board",
            help="Print a calibration board instead: charuco:10x7:25mm:18mm:DICT_5X5_100 "
            "(squares) or chessboard:9x6:25mm (inner corners).",
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option("--camera", help="Design: ranges of the target for this calibration file."),
    ] = None,
    ceiling: Annotated[
        float | None, typer.Option("--ceiling", help="Height of the ceiling over the floor, m.")
    ] = None,
    blur: Annotated[float, typer.Option("--blur", help="Sigma of the picture's blur, px.")] = 1.0,
    noise: Annotated[
        float, typer.Option("--noise", help="Sigma of the picture's noise, grey levels of 255.")
    ] = 5.0,
    plot: Annotated[
        Path | None, typer.Option("--plot", help="The design's picture (design.png).")
    ] = None,
    suggest: Annotated[
        bool, typer.Option("--suggest", help="Propose sizes and ids for --camera.")
    ] = False,
    measured_large: Annotated[
        str | None,
        typer.Option("--measured-large", help="Side of the large black square as printed, mm."),
    ] = None,
    measured_small: Annotated[
        str | None,
        typer.Option("--measured-small", help="Side of the small black square as printed, mm."),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Let --measured-* change an existing profile.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Print the target (or a board), true to size; design it; write measured sizes.

    Without --camera, --board or --measured-*: a PDF of the profile's target, front and back,
    checked before it is written. With --camera: from where to where each marker is seen.
    """
    with reported():
        from perchctl.commands import make_target as work

        request = work.TargetRequest(
            profile=profile,
            output=output,
            page=page,
            large=large,
            large_id=large_id,
            large_dict=large_dict,
            small=small,
            small_id=small_id,
            small_dict=small_dict,
            magnet=magnet,
            png_dpi=png,
            svg=svg,
            board=board,
            camera=camera,
            ceiling_m=ceiling,
            blur_px=blur,
            noise=noise,
            plot=plot,
            suggest=suggest,
            measured_large=measured_large,
            measured_small=measured_small,
            force=force,
            as_json=as_json,
        )
        print(work.run(request))


@app.command("fit-weights")
def fit_weights(
    data: Annotated[
        list[Path] | None,
        typer.Argument(help="CSV files, or logs (.jsonl) of lockstep flights, which know truth."),
    ] = None,
    profile: ProfileOption = "sim",
    session: Annotated[
        Path | None,
        typer.Option("--collect", help="Collect this CSV first; an unfinished one goes on."),
    ] = None,
    positions: Annotated[int, typer.Option("--positions", help="To collect.")] = 10,
    frames: Annotated[int, typer.Option("--frames", help="To collect at each position.")] = 100,
    truth: Annotated[
        str, typer.Option("--truth", help="The actual pose: typed, mocap, estimate or sim.")
    ] = "typed",
    source: Annotated[
        str | None, typer.Option("--source", help="Camera; else the profile's.")
    ] = None,
    uri: Annotated[
        str | None, typer.Option("--uri", "-u", help="Vehicle, for --truth estimate.")
    ] = None,
    mocap: Annotated[
        str | None, typer.Option("--mocap", help="TYPE:HOST, as in vicon:192.168.1.2.")
    ] = None,
    bodies: Annotated[
        str, typer.Option("--bodies", help="Rigid bodies of vehicle and target.")
    ] = "cf,target",
    target: Annotated[
        str | None,
        typer.Option("--target", help="Target in the world, 'x y z yaw' in m and deg."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the simulated places.")] = 0,
    noise: Annotated[float, typer.Option("--noise", help="Simulated, grey levels.")] = 4.0,
    blur: Annotated[float, typer.Option("--blur", help="Simulated, sigma in px.")] = 1.0,
    method: Annotated[
        str,
        typer.Option("--method", help="closed_form, lms, nlms or inverse_variance: to be used."),
    ] = "closed_form",
    step: Annotated[
        float | None,
        typer.Option("--step", help="LMS: constant step, in 1 / mean(d^2); else it falls."),
    ] = None,
    passes: Annotated[
        int | None, typer.Option("--passes", help="LMS: times through the data.")
    ] = None,
    order: Annotated[str, typer.Option("--order", help="LMS: shuffled or recorded.")] = "shuffled",
    start: Annotated[float, typer.Option("--start", help="LMS: first weight.")] = 0.5,
    test: Annotated[
        Path | None, typer.Option("--test", help="Judge the weights on this other data too.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--output", "-o", help="Weights file; else the profile's.")
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the evidence (.png).")] = None,
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Write weights that are not recommended, too.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Fit the merge weights to poses whose truth is known, and prove that they help.

    A CSV row is a frame: position (a number for the place), t_s, then x_m, y_m, z_m and yaw_rad
    of large_, small_ and actual_; the cells of a marker that was not seen are empty. joint_
    columns may follow. All three poses are in one frame; --collect writes the target relative to
    the gear in the level frame.
    """
    with reported():
        from perchctl.commands import fit_weights as work

        options = work.resolve(
            [*(data or []), *([session] if session else [])],
            profile,
            method=method,
            step=step,
            passes=passes,
            order=order,
            start=start,
            test=test,
            out=out,
            plot=plot,
            as_json=as_json,
            anyway=anyway,
        )
        if session is not None:
            from perchctl.commands import collect_weights

            collect_weights.collect(
                collect_weights.CollectOptions(
                    session,
                    profile,
                    positions,
                    frames,
                    truth,
                    source,
                    uri,
                    mocap,
                    bodies,
                    target,
                    seed,
                    noise,
                    blur,
                )
            )
        work.run(options)


def main() -> Any:
    """Entry point of the console script."""
    try:
        return app()
    except KeyboardInterrupt:
        print("perchctl: Ctrl-C", file=sys.stderr)
        return Interrupted.exit_code
