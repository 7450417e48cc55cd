"""Writes the parts of README.md and docs/*.md that are drawn from the code.

    python docs/tables.py

Each part stands between ``<!-- begin NAME -->`` and ``<!-- end NAME -->``; a test holds the pages
to what this command would write. A key's meaning is written in `MEANINGS`, below: a test names
each key of the schema that has none there, and each meaning that has no key.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from perchctl.errors import EXIT_CODES  # noqa: E402
from perchctl.faults.catalogue import AIR, FAULTS, FROM_THE_START, Fault  # noqa: E402
from perchctl.faults.excuses import EXCUSES  # noqa: E402
from perchctl.faults.promises import PROMISES  # noqa: E402
from perchctl.log.fields import EVENT_FIELDS, FIELDS  # noqa: E402
from perchctl.mission.diagram import diagram, rows_table  # noqa: E402
from perchctl.profile import Profile  # noqa: E402

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
BOUNDS = ("ge", "gt", "le", "lt")
PART = re.compile(r"(<!-- begin ([\w-]+) -->\n).*?(<!-- end \2 -->)", re.DOTALL)

UNITS = {
    "acc_g": "g",
    "deg": "deg",
    "dps": "deg/s",
    "g": "g",
    "hz": "Hz",
    "kg": "kg",
    "m": "m",
    "m2": "m^2",
    "mps": "m/s",
    "mps2": "m/s^2",
    "n": "N",
    "per_m": "1/m",
    "per_s": "1/s",
    "px": "px",
    "rad": "rad",
    "radps2": "rad/s^2",
    "s": "s",
    "v": "V",
}
"""A name's last word, and the unit that it stands for."""
UNITS_OF = {
    "kalman.k1": "cm^2, deg^2",
    "kalman.k2": "cm^2, deg^2",
    "simulation.camera_noise_sigma": "grey levels",
}

# One line a key.
MEANINGS = {
    "name": "of the profile; else its file's",
    "description": "one sentence for people",
    "date": "of the measurements in it; printed on the target",
    "camera.source": "`camera:N`, `http://...`, `video:FILE`, `images:DIR`, `sim:`",
    "camera.calibration": "file beside the profile, in `calib/`, or a whole path",
    "camera.cam": "which camera of a Kalibr file of several: `cam0`, `cam1`, ...",
    "camera.latency_s": "from exposure to arrival",
    "camera.mount.position_m": "the camera in body axes",
    "camera.mount.rpy_deg": "its turn from body axes ([Camera mount](conventions.md#camera-mount))",
    "camera.start_timeout_s": "wait for the first good picture",
    "camera.mirrored": "flip each picture before use",
    "camera.mask": "picture of what the vehicle itself covers, white ([own gear](#own-gear))",
    "camera.fields": "interlaced pictures: found by measure, or which field is earlier, or never",
    "camera.readout_s": "rolling shutter: from the first row to the last; none: not known",
    "vehicle.gear_body_m": "tip of the magnet gear in body axes",
    "target.large.dictionary": "an OpenCV dictionary",
    "target.large.id": "within the dictionary",
    "target.large.side_m": "of the black square, as printed",
    "target.small.dictionary": "an OpenCV dictionary",
    "target.small.id": "within the dictionary",
    "target.small.side_m": "as printed; less than half of the large one",
    "target.size_sigma": "share by which all printed sizes may be off; less once measured",
    "target.curl_per_m": "so much times r^2 a place r from the sheet's centre may be off its plane",
    "detector.refinement": "of corners: lines fitted to the sides, OpenCV's sub-pixel, or none",
    "detector.window": "look around the last pose first",
    "detector.blurred": "look once more where blur may hide the target",
    "detector.cut": "measure by what is left of the drawing where the picture cuts both markers",
    "detector.blurred_every": "... so in every Nth picture of a stream without it, "
    "not for a sharp one",
    "detector.correction_bits_large": "wrong cells that are corrected",
    "detector.correction_bits_small": "wrong cells that are corrected",
    "pose.solver": "OpenCV's solver for the first guess",
    "pose.refine": "least squares on the corners after it",
    "pose.max_reprojection_px": "no pose above this RMS",
    "pose.each_marker": "beside the joint pose also each marker's own, for the log",
    "kalman.k1": "measurement noise, the paper's R = k1 I, with `noise: fixed`",
    "kalman.k2": "process noise of a frame, the paper's Q = k2 I, with `noise: fixed`",
    "kalman.alpha": "a coasting track's speeds are multiplied by it each frame",
    "kalman.n_max": "frames for which a track coasts",
    "kalman.frame": "where tracks live: `level` as the paper, or `world`",
    "kalman.noise": "k1 and k2 for every frame, or each pose's own covariance and accelerations",
    "kalman.acceleration_mps2": "of camera or target in the level frame, with `noise: measured`",
    "kalman.turn_radps2": "of the camera's attitude and heading, likewise",
    "kalman.drift_mps2": "of the state estimate's drift, for tracks in the world, likewise",
    "kalman.attitude_sigma_deg": "constant error of roll and pitch, likewise",
    "kalman.gate": "a pose that contradicts the target's track is not taken",
    "kalman.drift_mps": "an unmeasured target moves in the estimate's world at most so fast",
    "merge.method": "the paper's weights, or both markers solved as one",
    "merge.weights.x": "the large marker's share; the small one has the rest",
    "merge.weights.y": "as x",
    "merge.weights.z": "as x",
    "merge.weights.yaw": "as x",
    "merge.weights_file": "of `perchctl fit-weights`; replaces `weights`",
    "merge.stages": "merge what is seen, or by distance as equations 4, 6, 11",
    "merge.z2_m": "farthest range of the small marker",
    "merge.z3_m": "nearest range of the whole large marker",
    "merge.disagreement_m": "farther apart than this the markers contradict",
    "merge.disagreement_frames": "so many in a row, and it lands",
    "planner.takeoff_height_m": "above the ground",
    "planner.takeoff_speed_mps": "of the setpoint, from the ground up",
    "planner.approach_xy_m": "fly here after take-off, in the estimate's world",
    "planner.approach_timeout_s": "for take-off and way",
    "planner.search.attempts": "times to wait, before it lands",
    "planner.search.wait_s": "at each height",
    "planner.search.step_m": "higher each time",
    "planner.search.max_height_m": "never above it to look for the target",
    "planner.search.yaw_step_deg": "turned each time",
    "planner.search.confirm_frames": "in a row with the target",
    "planner.estimate.dwell_s": "for which the pose must be steady",
    "planner.estimate.spread_m": "within which it must stay",
    "planner.estimate.timeout_s": "then back to search",
    "planner.align.xy_m": "aligned: the gear's distance from the target's axis",
    "planner.align.yaw_deg": "aligned: heading",
    "planner.align.dwell_s": "for which both must hold",
    "planner.align.timeout_s": "then the attempt counts as failed",
    "planner.align.speed_mps": "of the setpoint, sideways",
    "planner.align.yaw_rate_dps": "of the setpoint",
    "planner.ascend.speed_mps": "climb, far below",
    "planner.ascend.near_speed_mps": "climb, nearer than `near_m`",
    "planner.ascend.near_m": "from here on it climbs slowly",
    "planner.ascend.cone_base_m": "the cone's radius at the target",
    "planner.ascend.cone_slope": "the cone's radius grows by it a metre below",
    "planner.ascend.standoff_m": "between gear and target where it settles",
    "planner.ascend.settle_xy_m": "settled: distance from the axis",
    "planner.ascend.settle_z_m": "settled: at most so far below the stand-off",
    "planner.ascend.settle_yaw_deg": "settled: heading",
    "planner.ascend.settle_speed_mps": "settled: speed",
    "planner.ascend.settle_dwell_s": "for which all must hold",
    "planner.ascend.settle_timeout_s": "at the stand-off",
    "planner.ascend.fresh_s": "a target older than this, beyond the latency, is not fresh",
    "planner.ascend.timeout_s": "for the whole ascent",
    "planner.perch.mode": "press by a setpoint above the contact, or by raw thrust",
    "planner.perch.thrust": "of the raw mode",
    "planner.perch.press_m": "the setpoint above the contact",
    "planner.perch.climb_mps": "of the setpoint",
    "planner.perch.contact_dwell_s": "for which contact must hold",
    "planner.perch.contact_z_m": "contact: the gear's distance from the target",
    "planner.perch.contact_speed_mps": "contact: vertical speed",
    "planner.perch.contact_acc_g": "contact: acceleration differs from 1 g by at most this",
    "planner.perch.contact_thrust_ratio": "contact: thrust over hover thrust, where there is more",
    "planner.perch.timeout_s": "without contact",
    "planner.complete.steps": "of the release",
    "planner.complete.release_s": "over which the thrust is released",
    "planner.complete.release_drop_m": "the setpoint's last step lies below the contact",
    "planner.complete.hold_ratio": "thrust over the hover thrust that proves the magnet",
    "planner.complete.hold_dwell_s": "for which it must prove it",
    "planner.complete.ramp_s": "of raw thrust, from the least of position mode to still motors",
    "planner.complete.hang_s": "that the whole weight must hang before the motors stop",
    "planner.complete.release_timeout_s": "then the attempt counts as failed",
    "planner.complete.slip_m": "hanging: at most so far below the contact",
    "planner.complete.slip_mps": "a slip: sinking faster",
    "planner.complete.slip_dwell_s": "a slip: for so long; a free fall is answered at once",
    "planner.complete.slip_acc_g": "a free fall, or a slip wherever the estimate is: less",
    "planner.complete.watch_s": "after the motor stop, before it counts as perched",
    "planner.recover.descend_m": "below where the attempt ended",
    "planner.recover.dwell_s": "for which it must be steady",
    "planner.recover.steady_mps": "steady: speed",
    "planner.recover.timeout_s": "then it lands",
    "planner.landing.speed_mps": "of the landing",
    "planner.landing.handover_m": "above the ground: from here the vehicle lands by itself",
    "planner.landing.undershoot_m": "the landing aims so far below the ground",
    "planner.landing.drift_mps": "of the estimate's height: the aim sinks so fast",
    "planner.landing.timeout_s": "for which a landing is waited for",
    "planner.attempts": "perching attempts in all",
    "planner.perching_time_s": "then it lands",
    "planner.integral_per_s": "gain of the integral of the horizontal error",
    "planner.integral_limit_m": "of that integral",
    "safety.min_rest_v": "no flight begins below it",
    "safety.min_load_v": "in flight",
    "safety.battery_debounce_s": "below `min_load_v` before it lands",
    "safety.battery_stale_s": "grace for a reading that stands still",
    "safety.telemetry_hold_s": "age of telemetry: held",
    "safety.telemetry_land_s": "age of telemetry: landed",
    "safety.proof_age_s": "older telemetry proves nothing: no contact, no landing, no stop",
    "safety.camera_hold_s": "since the last good picture: held",
    "safety.camera_land_s": "since the last good picture: landed",
    "safety.max_frame_age_s": "an older picture is no measurement",
    "safety.jump_m": "a step of the estimate beyond its speed: a jump",
    "safety.jump_z_m": "a step of its height",
    "safety.jump_deg": "a step of its heading",
    "safety.heading_lost_deg": "step of the heading: down at once, level, by raw thrust",
    "safety.jump_mps": "a step of its velocity",
    "safety.flight_variance_m2": "of the position in flight: above it, held",
    "safety.variance_land_s": "above it for so long: landed",
    "safety.jump_hold_s": "held, then landed",
    "safety.max_height_m": "above the ground",
    "safety.fence_radius_m": "around the place of take-off",
    "safety.max_tilt_deg": "beyond it the motors are cut",
    "safety.tilt_debounce_s": "for which it must be tilted",
    "safety.loop_late_hold_s": "a turn so late: held",
    "safety.loop_late_land_s": "a turn so late: landed",
    "safety.estimator_wait_s": "on the ground",
    "safety.estimator_variance_m2": "of the position, at most, before take-off",
    "safety.ground_z_m": "height at which the estimate places the ground, where it takes off",
    "safety.ground_tolerance_m": "farther from it the vehicle hangs, or is held: no take-off",
    "safety.start_tilt_deg": "roll and pitch, at most, before take-off",
    "safety.blocked_s": "pressed against something and not moving: back off down",
    "safety.blocked_thrust_ratio": "of the hover thrust: from here on it is pressed",
    "safety.land_on_log_error": "land when the log cannot be written",
    "link.uri": "`sim://`, `radio://...`, `usb://0`, `udp://HOST:PORT`",
    "link.connect_timeout_s": "for both tries together",
    "link.parameters": "firmware parameters, set and read back before the flight",
    "link.telemetry_period_s": "of position and attitude",
    "link.loop_hz": "turns of the flight loop",
    "simulation.start_offset_m": "start under the target, at most so far aside in x and in y",
    "simulation.target_yaw_deg": "the target's heading",
    "simulation.ceiling_z_m": "over the floor",
    "simulation.mass_kg": "all-up",
    "simulation.battery_rest_v": "at the start",
    "simulation.camera_latency_s": "the true one",
    "simulation.camera_jitter_s": "of the latency, one sigma",
    "simulation.camera_rate_hz": "frames",
    "simulation.camera_drop_rate": "share of frames lost",
    "simulation.camera_burst_frames": "frames lost in one go, once a flight",
    "simulation.camera_noise_sigma": "of 255",
    "simulation.camera_exposure_s": "motion blur",
    "simulation.camera_defocus_px": "sigma of the lens's blur",
    "simulation.camera_fields": "interlaced: which row's field comes first",
    "simulation.camera_blended": "the two fields averaged, as some converters do",
    "simulation.camera_readout_s": "rolling shutter: from the first row to the last",
    "simulation.camera_flicker": "share of the light that comes and goes 100 times a second",
    "simulation.camera_pumping": "share by which an exposure control that hunts is off",
    "simulation.camera_analogue": "trembling, torn and lost lines; 1 is about to be lost",
    "simulation.mount_error_deg": "what the profile's mount is wrong by, at most",
    "simulation.mount_error_m": "what the profile's mount is wrong by, at most",
    "simulation.estimate_noise_m": "of the state estimate",
    "simulation.estimate_tilt_bias_deg": "of the state estimate, at most",
    "simulation.drift_mps": "of the state estimate",
    "simulation.draught_mps": "wind, with gusts",
    "simulation.magnet_force_n": "that the magnet holds",
    "simulation.first_contact_fails": "share of flights in which the first contact does not hold",
    "simulation.no_target": "a bare ceiling",
    "log.directory": "for the log and its plot",
    "log.plot": "draw the flight after it",
}


@dataclass(frozen=True)
class Key:
    """One leaf of the profile's schema."""

    path: str
    field: Any
    default: Any

    @property
    def section(self) -> str:
        """The headings that people read: the first word, and the planner's phases."""
        words = self.path.split(".")
        deep = words[0] == "planner" and len(words) > 2
        return ".".join(words[: 2 if deep else 1]) if len(words) > 1 else ""

    @property
    def unit(self) -> str:
        last = self.path.rpartition(".")[2]
        endings = (last.split("_", n)[-1] for n in range(1, last.count("_") + 1))
        return UNITS_OF.get(self.path) or next((UNITS[e] for e in endings if e in UNITS), "")


def keys(section: BaseModel, prefix: str = "") -> Iterator[Key]:
    """Every leaf below a section of the default profile, in the schema's order."""
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            yield from keys(value, f"{prefix}{name}.")
        else:
            yield Key(prefix + name, field, value)


def allowed(field: Any) -> str:
    """The bounds or choices of a field, in words."""
    kind = field.annotation
    optional = type(None) in get_args(kind)
    if optional:
        kind = next(a for a in get_args(kind) if a is not type(None))
    bounds = _bounds(field)
    if get_origin(kind) is Literal:
        text = ", ".join(f"`{choice}`" for choice in get_args(kind))
    elif bounds:
        text = _span(bounds)
    elif get_origin(kind) is tuple:
        count = len(get_args(kind))
        ordered = any(type(m).__name__ == "AfterValidator" for m in field.metadata)
        text = "lowest, highest" if ordered else f"{count} numbers"
    elif get_origin(kind) is dict:
        text = "name: number"
    else:
        text = {"bool": "true, false", "str": "text", "date": "YYYY-MM-DD"}.get(kind.__name__, "")
    return f"{text}, or none" if optional else text


def _bounds(field: Any) -> dict[str, float]:
    """``ge``, ``gt``, ``le`` and ``lt``, as far as they are given."""
    found = ((name, getattr(m, name, None)) for m in field.metadata for name in BOUNDS)
    return {name: value for name, value in found if value is not None}


def _span(bounds: dict[str, float]) -> str:
    low = f"{bounds['ge']:g}" if "ge" in bounds else f"above {bounds['gt']:g}"
    if "le" in bounds:
        return f"{low} to {bounds['le']:g}"
    if "lt" in bounds:
        return f"{low}, below {bounds['lt']:g}"
    return low if "gt" in bounds else f"at least {low}"


def profile_keys() -> str:
    """A table for each section."""
    sections: dict[str, list[str]] = {}
    for key in keys(Profile()):
        name = key.path.removeprefix(f"{key.section}.")
        meaning = MEANINGS.get(key.path, "(without a meaning in docs/tables.py)")
        cells = (f"`{name}`", key.unit, _shown(key.default), allowed(key.field), meaning)
        sections.setdefault(key.section, []).append(f"| {' | '.join(cells)} |")
    head = ["", "| key | unit | default | allowed | meaning |", "|---|---|---|---|---|"]
    lines: list[str] = []
    for section, rows in sections.items():
        lines += ["", f"### `{section}`" if section else "### At the top", *head, *rows]
    return "\n".join(lines[1:])


def _shown(value: Any) -> str:
    match value:
        case None | {} | "":
            return "none"
        case bool():
            return str(value).lower()
        case tuple():
            return f"`[{', '.join(_shown(v) for v in value)}]`"
        case int() | float():
            return f"{value:g}" if isinstance(value, float) else str(value)
    return f"`{value}`"


def log_fields(fields: dict[str, str] = FIELDS) -> str:
    rows = [f"| `{name}` | {_unit_of_field(name)} | {text} |" for name, text in fields.items()]
    return "\n".join(["| field | unit | meaning |", "|---|---|---|", *rows])


def _unit_of_field(name: str) -> str:
    last = name.rpartition("_")[2]
    return UNITS.get(last, "") if "_" in name else ""


def import_order() -> str:
    from tests.test_architecture import LAYERS

    names = (", ".join(f"`{room.removeprefix('perchctl.')}`" for room in rooms) for rooms in LAYERS)
    return "\n".join(f"{number}. {rooms}" for number, rooms in enumerate(names, start=1))


def exit_codes() -> str:
    rows = [f"| {code} | {meaning} |" for code, meaning in sorted(EXIT_CODES.items())]
    return "\n".join(["| code | meaning |", "|---|---|", *rows])


def fault_catalogue() -> str:
    head = ["| name | rows | what happens | begins in | excuses |", "|---|---|---|---|---|"]
    return "\n".join([*head, *map(_fault_row, FAULTS)])


def _fault_row(fault: Fault) -> str:
    rows = ", ".join(map(str, fault.rows))
    excuses = ", ".join(excuse.name for excuse in fault.excuses)
    return f"| `{fault.name}` | {rows} | {fault.what} | {_phases(fault)} | {excuses} |"


def _phases(fault: Fault) -> str:
    if fault.phases is FROM_THE_START:
        return "from the start"
    missing = [phase.value for phase in AIR if phase not in fault.phases]
    if len(missing) > 2:
        return ", ".join(phase.value for phase in fault.phases)
    return f"any phase but {', '.join(missing)}" if missing else "any phase"


def fault_excuses() -> str:
    rows = [
        f"| {excuse.name} | {', '.join(sorted(excuse.expected)).replace('_', ' ')} | "
        f"{excuse.reason} |"
        for excuse in EXCUSES
    ]
    return "\n".join(["| excuse | what is not counted | why |", "|---|---|---|", *rows])


def promises() -> str:
    rows = [f"| {promise.what} | {promise.happens} |" for promise in PROMISES]
    return "\n".join(["| what | what happens |", "|---|---|", *rows])


PARTS: dict[str, Callable[[], str]] = {
    "import-order": import_order,
    "diagram": lambda: f"```mermaid\n{diagram()}\n```",
    "rows": rows_table,
    "profile-keys": profile_keys,
    "log-fields": log_fields,
    "event-fields": lambda: log_fields(EVENT_FIELDS),
    "exit-codes": exit_codes,
    "fault-catalogue": fault_catalogue,
    "fault-excuses": fault_excuses,
    "promises": promises,
}


def filled(page: str) -> str:
    """The page with its parts as the code has them. KeyError for a part that is none."""
    return PART.sub(lambda m: f"{m[1]}{PARTS[m[2]]()}\n{m[3]}", page)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="change nothing; exit 1 if it would")
    check = parser.parse_args().check
    changed = False
    for path in PAGES:
        old = path.read_text(encoding="utf-8")
        new = filled(old)
        if new != old:
            changed = True
            print(f"{path.relative_to(ROOT)}: {'is not as the code' if check else 'changed'}")
            if not check:
                path.write_text(new, encoding="utf-8")
    return int(check and changed)


if __name__ == "__main__":
    sys.exit(main())
