"""Every picture of the README and of these pages.

    python docs/pictures/make.py

flies one simulated flight (`--profile`, `--seed`; or takes a log with `--log`) and writes the
pictures beside this file (`--into`, `--only`). The live page is photographed by a headless
Chromium; where none is installed that picture is left as it is, and the command says so.
"""

from __future__ import annotations

import argparse
import io
import math
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, PathPatch, Polygon, Rectangle
from matplotlib.path import Path as MplPath
from numpy.typing import NDArray
from rich.console import Console
from rich.text import Text

ROOT = Path(__file__).resolve().parents[2]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from perchctl.analysis import plot_flight, write_report  # noqa: E402
from perchctl.calibration import profile_camera  # noqa: E402
from perchctl.display import (  # noqa: E402
    LivePage,
    Sketch,
    make_sketch,
)
from perchctl.display.page import flight_state  # noqa: E402
from perchctl.display.panel import status_panel  # noqa: E402
from perchctl.flight import KEY_HELP, STOP_HELP, FlyOptions  # noqa: E402
from perchctl.geometry import make_T, rotation_from_rpy  # noqa: E402
from perchctl.mission import Observation, Phase, PlannerState, Tick, TickInputs, TickRecord  # noqa: E402
from perchctl.mission.state import BatteryOutlook, PhaseEntry  # noqa: E402
from perchctl.plot import (  # noqa: E402
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    VERMILLION,
    new_figure,
)
from perchctl.profile import Profile, load_profile  # noqa: E402
from perchctl.record import (  # noqa: E402
    FlightLog,
    read_log,
)
from perchctl.sim import (  # noqa: E402
    Renderer,
    draw_scenario,
)
from perchctl.vehicle import Idle, Telemetry  # noqa: E402
from perchctl.vision import Frame, PipelineState, TargetEstimate, make_pipeline, step  # noqa: E402
from perchctl.vision.markers.detect import CORNER_METHODS  # noqa: E402
from perchctl.vision.types import VisibleMarkers  # noqa: E402

PAGE_PX, REPORT_PX = (1280, 760), (1200, 1250)
PAGE_S = 8.0  # of the flight, on the page before it is photographed
FILM = ("--rate", "6", "--width", "640")
"""Small enough for the README: at most 3 MB."""


@dataclass(frozen=True)
class Flight:
    """A logged simulated flight, and what its seed says about the world it was flown in."""

    log: FlightLog

    @cached_property
    def profile(self) -> Profile:
        return self.log.flown_profile

    @cached_property
    def scenario(self) -> Any:
        return draw_scenario(self.profile, int(self.log.header["seed"]))

    @cached_property
    def camera(self) -> Any:
        return profile_camera(self.profile.camera)

    @cached_property
    def renderer(self) -> Renderer:
        return Renderer(self.scenario, self.camera, self.profile.target)

    @cached_property
    def pipeline(self) -> Any:
        return make_pipeline(self.profile, self.camera)

    def index_at(self, t_s: float) -> int:
        """The tick at that time, s after the first."""
        after = self.log.column("t_s") >= self.log.start_s + t_s - 1e-6
        return int(np.argmax(after)) if after.any() else len(self.log.records) - 1

    def frame(self, index: int) -> Frame:
        """What the camera sees at that tick: rendered anew, from the logged truth."""
        r = self.log.records[index]
        R = rotation_from_rpy(r["roll_rad"], r["pitch_rad"], r["yaw_rad"])
        T_world_body = make_T(R, (r["true_x_m"], r["true_y_m"], r["true_z_m"]))
        T_world_cam = T_world_body @ np.array(self.scenario.T_body_cam_true)
        image = self.renderer.render([T_world_cam], frame_index=index)
        return Frame(index, float(r["t_s"]), image)

    def sketch(self, frame: Frame) -> Sketch:
        """The frame with what the pipeline finds in it."""
        _, output = step(PipelineState(), frame, None, self.pipeline)
        return make_sketch(frame, output, self.profile.target.large.side_m)

    def tick(self, index: int) -> Tick:
        """What the displays showed at that tick."""
        r, first = self.log.records[index], self.log.records[0]
        since_s = self.log.to_flight_s(float(r["t_s"]))
        span = next(s for s in reversed(self.log.phases) if s.start_s <= since_s)
        t_s, still = r["t_s"], (0.0, 0.0, 0.0)
        place = (r["x_m"], r["y_m"], r["z_m"])
        telemetry = Telemetry(t_s, place, still, *still, 1.0, 0.0, r["battery_v"], 0)
        target = None
        if r["ex_m"] is not None:
            e_m, tracked = np.array([r["ex_m"], r["ey_m"], r["ez_m"]]), bool(r["tracked"])
            yaw_rad = np.nan if r["eyaw_rad"] is None else r["eyaw_rad"]
            target = TargetEstimate(
                t_s, t_s, t_s, VisibleMarkers(r["stage"] or "none"), tracked, tracked, 0, e_m,
                yaw_rad, np.zeros(3), np.zeros(3), 0.0,
            )  # fmt: skip
        battery = BatteryOutlook(
            r["battery_left_s"], r["battery_attempts"], r["battery_used_mah"], r["battery_rest_v"]
        )
        on_ground = replace(telemetry, position_m=(0.0, 0.0, first["z_m"]))
        state = replace(
            PlannerState.initial_on_ground(Observation(t_s, on_ground), self.profile),
            phase=Phase(r["phase"]), failed_attempts=r["attempts"], battery=battery,
            entry=PhaseEntry(t_s=t_s - (since_s - span.start_s), reason=r["reason"]),
        )  # fmt: skip
        obs = Observation(
            t_s, replace(telemetry, behind_s=r["tel_age_s"]), target,
            last_good_frame_age_s=r["cam_age_s"], tick_start_delay_s=r["late_s"],
        )  # fmt: skip
        turn = TickRecord(
            number=index, role="flown", began_s=t_s, t_s=t_s, inputs=TickInputs(),
            observation=obs, command=Idle(),
        )  # fmt: skip
        return Tick(record=turn, state=state)


# --- the pictures ---------------------------------------------------------------------


def target(_: Flight, file: Path) -> None:
    """Front and back of the printed target, side by side."""
    import pypdfium2  # type: ignore[import-untyped]

    with tempfile.TemporaryDirectory() as folder:
        pdf = Path(folder) / "target.pdf"
        _perchctl("make-target", "-p", "sim", "-o", str(pdf))
        sheets = []
        for page in pypdfium2.PdfDocument(pdf.read_bytes()):
            # Drawn fine and shrunk: thin lines stay visible in a small picture.
            fine = page.render(scale=4 * 75 / 72.0, grayscale=True).to_numpy()
            small = cv2.resize(
                fine.reshape(fine.shape[:2]), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA
            )
            sheets.append(np.pad(small, 1, constant_values=150))
    gap = np.full((sheets[0].shape[0], 16), 255, np.uint8)
    _write(file, np.hstack([sheets[0], gap, sheets[1]]))


def flight(flown: Flight, file: Path) -> None:
    """The plot that each flight leaves beside its log."""
    plot_flight(flown.log, file)


def film(flown: Flight, file: Path) -> None:
    """The flight as a film, which the README shows."""
    _perchctl(
        "log", "film", str(flown.log.path.resolve()), "-o", str(file.resolve()), "--force", *FILM
    )


def fleet_film(_: Flight, file: Path) -> None:
    """The shipped fleet of four simulated vehicles, in real time, as a film."""
    with tempfile.TemporaryDirectory() as folder:
        _perchctl("fleet", "fly", "--yes", "--record", "--log-dir", folder)
        (flown,) = Path(folder).iterdir()
        rate = ("--rate", "4", *FILM[2:])
        _perchctl("log", "film", str(flown), "-o", str(file.resolve()), "--force", *rate)


def terminal(flown: Flight, file: Path) -> None:
    """The panel in a terminal, with the lines above it."""
    index = _shown(flown)
    console = Console(record=True, width=82, file=io.StringIO(), force_terminal=True)
    console.print(Text("$ perchctl fly"))
    for span in flown.log.phases:
        if span.start_s > flown.log.records[index]["t_s"]:
            break
        text = f"[{span.start_s - flown.log.start_s:7.2f} s] {span.phase}: {span.reason}"
        console.print(Text(text), soft_wrap=True)
    console.print(status_panel(flown.tick(index), STOP_HELP, KEY_HELP))
    svg = console.export_svg(title="perchctl", unique_id="perchctl")
    # Fonts from another server would be fetched by each reader.
    svg = re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL)
    file.write_text(svg.replace("Fira Code, ", ""), encoding="utf-8")


def page(flown: Flight, file: Path) -> None:
    """The live page of the flight, in a browser without a window."""
    last = _shown(flown)
    first = flown.index_at(float(flown.log.records[last]["t_s"]) - flown.log.start_s - PAGE_S)
    picture, shown = flown.sketch(flown.frame(last)), [first]
    profile = flown.profile
    drawn = {"large_m": profile.target.large.side_m, "gear_m": profile.vehicle.gear_body_m[2]}
    live = LivePage(flown.camera, "perchctl fly sim://", lambda: None, lambda: None)
    closing = threading.Event()

    def feed() -> None:
        """As a flight does: 30 pictures a second."""
        start_s = time.monotonic()
        while not closing.wait(1.0 / 30.0):
            passed = min(1.0, (time.monotonic() - start_s) / PAGE_S)
            shown.append(first + round(passed * (last - first)))
            live.show(picture)

    live.set_state(lambda: flight_state(flown.tick(shown[-1]), drawn), live=False)
    feeder = threading.Thread(target=feed, daemon=True)
    feeder.start()
    try:
        _photograph(file, live.url, PAGE_PX, f"performance.now() > {1e3 * PAGE_S + 1000:g}", 0.8)
    finally:
        closing.set()
        live.close()
        feeder.join()


def report(flown: Flight, file: Path) -> None:
    """The head of the report of the flight, in a browser without a window."""
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "report.html"
        write_report([flown.log.path], told)
        _photograph(file, told.as_uri(), REPORT_PX, scale=0.7)


def vehicle_drawing(flown: Flight, file: Path) -> None:
    """The vehicle from the side and from above, to scale: camera, gear, decks, dimensions, axes."""
    figure = new_figure(11.0, 6.0, dpi=100)
    side, above = figure.subplots(1, 2)
    lens_m, gear_m = flown.profile.camera.mount.position_m, flown.profile.vehicle.gear_body_m
    for ax, title in ((side, "from its right side"), (above, "from above")):
        ax.set_title(title, fontsize=11)
        ax.set_aspect("equal")
        ax.set_axis_off()
        ax.set_xlim(-0.078, 0.078)
        ax.set_ylim(-0.078, 0.078)
    _side_view(side, gear_m[2], lens_m, 0.0)
    side.fill(
        (lens_m[0], lens_m[0] - 0.04, lens_m[0] + 0.04), (lens_m[2], 0.058, 0.058),
        color=VERMILLION, alpha=0.12, linewidth=0.0,
    )  # fmt: skip
    _label(side, "magnet: the highest point", (gear_m[0] - 0.004, gear_m[2]), (-0.076, 0.048))
    _label(side, "gear", (gear_m[0] - 0.002, 0.02), (-0.05, 0.028))
    _label(side, "camera, looks up", (lens_m[0] + 0.004, lens_m[2] - 0.003), (0.03, 0.064))
    _label(side, "battery", (-0.013, 0.004), (-0.07, -0.03))
    _label(side, "Flow deck", (-0.006, DECK_BELOW_M + 0.001), (-0.052, -0.04))
    _size(side, (-0.062, FEET_M), (-0.062, ROTOR_M), f"{1e3 * (ROTOR_M - FEET_M):.0f} mm")
    _size(side, (0.064, 0.0), (0.064, gear_m[2]), f"{1e3 * gear_m[2]:.0f} mm")
    _size(side, (0.0, -0.03), (lens_m[0], -0.03), f"{1e3 * lens_m[0]:.0f} mm")
    for at in ((gear_m[0] + 0.007, 0.064, gear_m[2]), (0.045, 0.064, 0.0)):
        side.plot(at[:2], (at[2], at[2]), color=GREY, linewidth=0.6)
    _arrow(side, (-0.07, -0.075), (0.03, 0.0), "x: front")
    _arrow(side, (-0.07, -0.075), (0.0, 0.022), "z: up")
    _view_from_above(above, gear_m, lens_m)
    _label(above, "gear: its tip over the middle", (gear_m[0] - 0.003, 0.004), (-0.076, 0.072))
    _label(above, "camera", (lens_m[0] + 0.006, lens_m[1]), (0.056, 0.006))
    _label(above, "deck on top", (-0.013, -0.006), (-0.077, -0.006))
    _size(above, (-MOTOR_M, -0.065), (MOTOR_M, -0.065), f"{2e3 * MOTOR_M:.0f} mm")
    _size(
        above, (MOTOR_M - PROPELLER_M, 0.065), (MOTOR_M + PROPELLER_M, 0.065),
        f"{2e3 * PROPELLER_M:.0f} mm",
    )  # fmt: skip
    _arrow(above, (-0.07, -0.075), (0.03, 0.0), "x: front")
    _arrow(above, (-0.07, -0.075), (0.0, 0.022), "y: left")
    _save_svg(figure, file)


def sheet_drawing(flown: Flight, file: Path) -> None:
    """A cut through the sheet under a ceiling, with its magnet, and the vehicle below."""
    figure = new_figure(8.0, 4.2, dpi=100)
    ax = figure.subplots()
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.set_xlim(-0.17, 0.17)
    ax.set_ylim(-0.09, 0.07)
    half_m = 0.105
    ax.add_patch(Rectangle((-0.17, 0.042), 0.34, 0.028, color="#D5D5D5"))
    for x in (-0.09, 0.075):
        ax.add_patch(Rectangle((x, 0.006), 0.015, 0.036, color="#B89B72"))
    ax.add_patch(Rectangle((-half_m, 0.002), 2 * half_m, 0.004, color="#B89B72"))
    ax.add_patch(Rectangle((-0.025, 0.006), 0.05, 0.005, color=VERMILLION))
    ax.add_patch(Rectangle((-half_m, 0.0), 2 * half_m, 0.002, color=BLACK))
    gear_m, lens_m = flown.profile.vehicle.gear_body_m[2], flown.profile.camera.mount.position_m
    _side_view(ax, gear_m, lens_m, -gear_m - 0.012)
    _label(ax, "ceiling or shelf", (-0.14, 0.05), (-0.165, 0.058))
    _label(ax, "spacers, three or more", (0.083, 0.024), (0.1, 0.03))
    _label(ax, "stiff board, flat", (-0.09, 0.004), (-0.168, 0.016))
    _label(ax, "magnet, 50 mm, glued on the back", (0.02, 0.008), (-0.058, 0.03))
    _label(ax, "printed side, faces down", (0.06, 0.0), (0.07, -0.02))
    _arrow(ax, (-0.15, -0.07), (0.03, 0.0), "target x")
    _arrow(ax, (-0.15, -0.07), (0.0, 0.03), "target z: up")
    _save_svg(figure, file)


def wiring_drawing(_: Flight, file: Path) -> None:
    """How an analogue video transmitter gets its power."""
    figure = new_figure(8.0, 2.6, dpi=100)
    ax = figure.subplots()
    ax.set_axis_off()
    ax.set_xlim(0.0, 10.0)
    ax.set_ylim(0.0, 3.2)
    boxes = (
        (0.2, "battery\n1 cell, 250 mAh", GREY), (2.9, "Crazyflie\nVCOM, GND", BLUE),
        (5.6, "camera with\ntransmitter", VERMILLION), (8.3, "receiver\nUSB", GREEN),
    )  # fmt: skip
    for x, text, colour in boxes:
        ax.add_patch(Rectangle((x, 1.0), 1.6, 1.3, fill=False, edgecolor=colour, linewidth=2.0))
        ax.text(x + 0.8, 1.65, text, ha="center", va="center", fontsize=9)
    for x, text in ((1.8, "plug"), (4.5, "+ and -"), (7.2, "5.8 GHz")):
        style = "dashed" if text == "5.8 GHz" else "solid"
        ax.plot((x, x + 1.1), (1.65, 1.65), color=BLACK, linestyle=style)
        ax.text(x + 0.55, 1.8, text, ha="center", fontsize=8)
    ax.text(5.05, 0.45, "VCOM is the battery's voltage, 3.0 to 4.2 V", ha="center", fontsize=9)
    _save_svg(figure, file)


# A Crazyflie 2.1+ by its data sheets, m.
MOTOR_M = 0.0325
"""Of a motor from the middle, along x and along y: 92 mm from motor to motor across."""
PROPELLER_M = 0.0235
"""The radius of a propeller 47-17."""
ARM_M = 0.0283
"""Of the end of the board's arm from the middle, along x and along y."""
PIN_ROW_M = 0.011
"""Of a row of deck pins from the middle, along y."""
DECK_M = 0.028
"""The side of a deck."""
FEET_M, ROTOR_M = -0.018, 0.011
"""The lowest and the highest point of the bare vehicle: 29 mm. The share above the board is an
estimate, as are the heights of the decks."""
DECK_BELOW_M, DECK_ABOVE_M = -0.0075, 0.0105


def _side_view(ax: Axes, gear_m: float, lens_m: Sequence[float], z_m: float) -> None:
    """A Crazyflie with its parts from its right side, its board at the height `z_m`."""

    def box(x: float, z: float, width: float, height: float, colour: str, **more: Any) -> None:
        more = {"facecolor": colour, "edgecolor": BLACK, "linewidth": 0.5} | more
        ax.add_patch(Rectangle((x, z_m + z), width, height, **more))

    for x in (-MOTOR_M, MOTOR_M):
        box(x - 0.0046, -0.010, 0.0092, 0.013, "#B9B9B9")  # the mount, and its foot
        ax.add_patch(
            Polygon(
                [(x + dx, z_m + z) for dx, z in ((-0.0046, -0.010), (0.0046, -0.010),
                                                 (0.0015, FEET_M), (-0.0015, FEET_M))],
                facecolor="#B9B9B9", edgecolor=BLACK, linewidth=0.5,
            )
        )  # fmt: skip
        box(x - 0.0035, 0.003, 0.007, 0.0045, GREY)  # the motor
        box(x - 0.0012, 0.0075, 0.0024, ROTOR_M - 0.0075, BLACK)
        box(x - PROPELLER_M, ROTOR_M - 0.0022, 2 * PROPELLER_M, 0.0012, BLACK, alpha=0.75)
    box(-ARM_M, -0.0008, 2 * ARM_M, 0.0016, BLUE)
    box(-0.015, 0.0012, 0.030, 0.007, "#D9D9D9")  # the battery
    for pin in range(10):
        box(-0.009 + 0.002 * pin - 0.00025, -0.009, 0.0005, 0.0225, ORANGE, linewidth=0.0)
    box(-0.0105, DECK_BELOW_M, 0.021, 0.0016, GREEN)
    box(-0.006, DECK_BELOW_M - 0.002, 0.005, 0.002, BLACK)  # its two sensors
    box(0.002, DECK_BELOW_M - 0.001, 0.004, 0.001, BLACK)
    box(-DECK_M / 2, DECK_ABOVE_M, DECK_M, 0.0016, GREEN)
    foot, top = DECK_ABOVE_M + 0.0016, gear_m - 0.002
    x = lens_m[0]  # the camera, and the strip that carries it
    strip = (
        (DECK_M / 2, DECK_ABOVE_M),
        (x - 0.008, lens_m[2] - 0.007),
        (x + 0.006, lens_m[2] - 0.007),
    )
    ax.plot([p for p, _ in strip], [z_m + q for _, q in strip], color=BLACK, linewidth=1.5)
    box(x - 0.006, lens_m[2] - 0.007, 0.012, 0.004, VERMILLION)
    box(x - 0.0035, lens_m[2] - 0.003, 0.007, 0.003, BLACK)
    box(-0.010, foot, 0.020, 0.004, "#8A8A8A")  # the gear, as docs/gear.scad has it
    outline = (
        (0.0025, foot + 0.004), (0.0025, top - 0.0047), (0.006, top - 0.0012), (0.006, top),
    )  # fmt: skip
    shape = [*outline, *((-p, q) for p, q in reversed(outline))]
    ax.add_patch(
        Polygon(
            [(p, z_m + q) for p, q in shape], facecolor="#8A8A8A", edgecolor=BLACK, linewidth=0.5
        )
    )
    box(-0.006, top, 0.012, 0.002, BLACK)


def _view_from_above(ax: Axes, gear_m: Sequence[float], lens_m: Sequence[float]) -> None:
    """A Crazyflie with its parts from above; the front is on the right."""
    near, far = ARM_M - 0.0035, ARM_M
    corners = [(far, near), (near, far), (-near, far), (-far, near),
               (-far, -near), (-near, -far), (near, -far), (far, -near)]  # fmt: skip
    points, codes = [corners[0]], [MplPath.MOVETO]
    for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
        if abs(start[0]) != abs(end[0]):  # the end of an arm
            points, codes = [*points, end], [*codes, MplPath.LINETO]
            continue
        # Between two arms the board's edge curves in.
        inwards = [(0.4 * x, 0.36 * y) if start[1] == end[1] else (0.36 * x, 0.4 * y)
                   for x, y in (start, end)]  # fmt: skip
        points, codes = [*points, *inwards, end], [*codes, *[MplPath.CURVE4] * 3]
    ax.add_patch(PathPatch(MplPath(points, codes), facecolor=BLUE, edgecolor=BLACK, linewidth=0.6))
    for x in (-MOTOR_M, MOTOR_M):
        for y in (-MOTOR_M, MOTOR_M):
            inner = (math.copysign(near - 0.003, x), math.copysign(near - 0.003, y))
            ax.plot((inner[0], x), (inner[1], y), color="#B9B9B9", linewidth=5.0, zorder=1.0)
            ax.add_patch(Circle((x, y), PROPELLER_M, facecolor=GREY, alpha=0.12, linewidth=0.0))
            ax.add_patch(Circle((x, y), PROPELLER_M, fill=False, color=GREY, linewidth=0.6))
            ax.add_patch(Circle((x, y), 0.0046, facecolor="#B9B9B9", edgecolor=BLACK))
            turned = 35.0 if x * y > 0 else -35.0
            ax.add_patch(Ellipse((x, y), 2 * PROPELLER_M, 0.0045, angle=turned, color=BLACK))
            ax.add_patch(Circle((x, y), 0.0012, color="#B9B9B9"))
    half = DECK_M / 2
    ax.add_patch(Rectangle((-half, -half), DECK_M, DECK_M, facecolor=GREEN, edgecolor=BLACK))
    for y in (-PIN_ROW_M, PIN_ROW_M):
        ax.add_patch(Rectangle((-0.010, y - 0.0015), 0.020, 0.003, facecolor="#8A8A8A"))
    ax.add_patch(Rectangle((-0.003, -0.0125), 0.006, 0.025, facecolor="#8A8A8A"))
    ax.add_patch(Circle(gear_m[:2], 0.006, color=BLACK))
    ax.add_patch(Circle(gear_m[:2], 0.0025, color="#8A8A8A"))
    x, y = lens_m[:2]
    ax.plot((half, x), (y, y), color=BLACK, linewidth=4.0)
    ax.add_patch(Rectangle((x - 0.006, y - 0.006), 0.012, 0.012, color=VERMILLION))
    ax.add_patch(Circle((x, y), 0.0035, color=BLACK))


def _size(ax: Axes, start: tuple[float, float], end: tuple[float, float], text: str) -> None:
    """A dimension: a line with two arrowheads and its length beside it."""
    ax.annotate("", end, start, arrowprops={"arrowstyle": "<->", "color": GREY, "linewidth": 0.8,
                                            "shrinkA": 0.0, "shrinkB": 0.0})  # fmt: skip
    middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
    upright = start[0] == end[0]
    ax.text(
        middle[0] + (0.0015 if upright else 0.0), middle[1] + (0.0 if upright else 0.0015), text,
        fontsize=9, ha="left" if upright else "center", va="center" if upright else "bottom",
    )  # fmt: skip


def _label(ax: Axes, text: str, at: tuple[float, float], words: tuple[float, float]) -> None:
    line = {"arrowstyle": "-", "color": GREY, "linewidth": 0.8}
    ax.annotate(text, at, words, fontsize=9, arrowprops=line)


def _arrow(ax: Axes, at: tuple[float, float], way: tuple[float, float], text: str) -> None:
    to = (at[0] + way[0], at[1] + way[1])
    ax.annotate("", to, at, arrowprops={"arrowstyle": "->", "color": BLACK})
    ax.text(to[0] + 0.002, to[1] + 0.001, text, fontsize=9)


def _save_svg(figure: Figure, file: Path) -> None:
    """The same bytes for the same drawing: no date, ids from a fixed salt."""
    with rc_context({"svg.hashsalt": "perchctl", "svg.fonttype": "path"}):
        figure.savefig(file, format="svg", metadata={"Date": None}, bbox_inches="tight")


def corner_method(_: Flight, file: Path) -> None:
    """How one of the methods finds corners, in a view of its own."""
    from corners import PICTURES as by_name

    by_name[CORNERS[file.name]](file)


CORNERS = {
    f"corners-{method.name.lower().replace(' ', '-')}.png": method.name for method in CORNER_METHODS
}
PICTURES: dict[str, Callable[[Flight, Path], None]] = {
    "vehicle.svg": vehicle_drawing,
    "sheet.svg": sheet_drawing,
    "wiring.svg": wiring_drawing,
    "target.png": target,
    "flight.png": flight,
    "film.gif": film,
    "fleet.gif": fleet_film,
    "panel.svg": terminal,
    "page.png": page,
    "report.png": report,
    **dict.fromkeys(CORNERS, corner_method),
}


# --- what they share ------------------------------------------------------------------


def _within(flown: Flight, phase: str, share: float) -> float | None:
    """The time at which a share of the phase's last stay is over; None if it was not flown."""
    spans = [span for span in flown.log.phases if span.phase == phase]
    if not spans:
        return None
    return spans[-1].start_s + share * spans[-1].duration_s - flown.log.start_s


def _shown(flown: Flight) -> int:
    """The tick of the displays' pictures: in the ascent, or else at the end."""
    t_s = _within(flown, "ASCEND", 0.35)
    return len(flown.log.records) - 1 if t_s is None else flown.index_at(t_s)


def _photograph(
    file: Path, url: str, size_px: tuple[int, int], until: str = "true", scale: float = 1.0
) -> None:
    from browser import browsing, why_no_browser

    if why := why_no_browser():
        print(f"{file.name}: skipped, {why}")
        return
    with browsing() as browser:
        browser.open(url, *size_px)
        browser.until(until)
        shot = browser.photograph()
    if scale != 1.0:
        shot = np.asarray(cv2.resize(shot, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    _write(file, shot)


def _perchctl(*words: str) -> None:
    subprocess.run(
        [sys.executable, "-m", "perchctl", *words], cwd=ROOT, check=True, capture_output=True
    )


def _write(file: Path, picture: NDArray[np.uint8]) -> None:
    cv2.imwrite(str(file), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def fly(profile: str, seed: int, folder: Path) -> FlightLog:
    where = ("--log-dir", str(folder), "--record")
    _perchctl("simulate", "-p", profile, "-n", "1", "--seed", str(seed), *where)
    return read_log(folder / f"flight_seed{seed}.jsonl")


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--into", type=Path, default=Path(__file__).parent, help="folder")
    parser.add_argument("--only", nargs="+", choices=sorted(PICTURES), default=list(PICTURES))
    parser.add_argument("--profile", default="sim")
    parser.add_argument("--seed", type=int, default=FlyOptions.seed)
    parser.add_argument("--log", type=Path, help="a lockstep flight's log, instead of flying")
    given = parser.parse_args(words)
    with tempfile.TemporaryDirectory() as folder:
        profile = load_profile(given.profile).name if given.log is None else ""
        log = read_log(given.log) if given.log else fly(given.profile, given.seed, Path(folder))
        if profile:
            print(f"profile {profile}, seed {given.seed}: {log.phases[-1].phase}")
        flown = Flight(log)
        for name in given.only:
            file = given.into / name
            PICTURES[name](flown, file)
            if file.exists():
                print(f"{file}: {file.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
