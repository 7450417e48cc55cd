"""The options of `perchctl fit-weights`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.command_line import (
    Command,
    ForceOption,
    JsonOption,
    ProfileOption,
    complete_source,
    new_app,
    perform,
    reported,
)


def fit_weights(
    data: Annotated[
        list[Path] | None,
        typer.Argument(
            help="CSV files, or logs (.jsonl) of lockstep flights, which hold the truth."
        ),
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
        str | None,
        typer.Option(
            "--source", help="Camera; else the profile's.", autocompletion=complete_source
        ),
    ] = None,
    uri: Annotated[
        str | None, typer.Option("--uri", "-u", help="Vehicle, for --truth estimate.")
    ] = None,
    mocap: Annotated[
        str | None,
        typer.Option("--mocap", help="TYPE:HOST, as in vicon:192.168.1.2; else the profile's."),
    ] = None,
    bodies: Annotated[
        str | None,
        typer.Option(
            "--bodies", help="Rigid bodies of vehicle and target; else the profile's, and target."
        ),
    ] = None,
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
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Weights file; else the profile's.")
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the evidence (.png).")] = None,
    anyway: Annotated[
        bool, typer.Option("--anyway", help="Write weights that are not recommended, too.")
    ] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Fit the merge weights to poses whose truth is known, and verify that they help.

    A CSV row is a frame: position (a number for the place), t_s, then x_m, y_m, z_m and yaw_rad
    of large_, small_ and actual_; the cells of a marker that was not seen are empty. joint_
    columns may follow. All three poses are in one frame; --collect writes the target relative to
    the gear in the level frame.
    """
    with reported(as_json):
        from perchctl.commands.fit_weights import CollectRequest, FitRequest, run

        collecting = CollectRequest(
            session=session,
            profile=profile,
            positions=positions,
            frames=frames,
            truth=truth,
            source=source,
            uri=uri,
            mocap=mocap,
            bodies=bodies,
            target=target,
            seed=seed,
            noise=noise,
            blur=blur,
        )
        request = FitRequest(
            data=tuple(data or ()),
            profile=profile,
            collecting=collecting,
            method=method,
            step=step,
            passes=passes,
            order=order,
            start=start,
            test=test,
            output=output,
            plot=plot,
            anyway=anyway,
            force=force,
            as_json=as_json,
        )
        perform(run, request)


app = new_app()
app.command(cls=Command)(fit_weights)
