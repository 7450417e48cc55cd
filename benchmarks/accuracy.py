"""Errors of the target's pose by range and degradation, ours beside the paper's way (each
marker alone, EPnP, raw corners, weights), and whether the claimed spread is true."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from common import (
    CAMERA,
    SIDES_M,
    Picture,
    arguments,
    camera_pose,
    in_view,
    marker_pose,
    plain_detect,
    renderer,
    rms,
    scene_picture,
    scenes,
    setup_with,
    table,
    true_corners,
)

from perchctl.geometry import Array, wrap_rad
from perchctl.profile import DetectorConfig, MergeConfig
from perchctl.vision import (
    CameraModel,
    Frame,
    MarkerPose,
    Pipeline,
    PipelineOutput,
    PipelineState,
    square_corners,
    step,
)

NEAR_M = 0.25
HEAD = ("", "frames", "x mm", "y mm", "z mm", "yaw deg", "max mm", "max deg", "sq. error/dof",
        "paper's x y z mm, yaw deg")  # fmt: skip


@dataclass(frozen=True, eq=False)
class View:
    group: str
    image: Picture
    rvec: Array
    tvec: Array


def best_pose(output: PipelineOutput) -> MarkerPose | None:
    poses = output.poses
    return next((poses[n] for n in ("joint", "large", "small") if n in poses), None)


def look(setup: Pipeline, image: Picture) -> PipelineOutput:
    return step(PipelineState(), Frame(0, 0.0, image), None, setup)[1]


def error_of(e_m: Array, yaw_rad: float, view: View) -> Array:
    """(x, y, z) in m and yaw in rad."""
    R = cv2.Rodrigues(view.rvec)[0]
    return np.append(e_m - view.tvec, wrap_rad(yaw_rad - math.atan2(R[1, 0], R[0, 0])))


def report(title: str, views: Iterator[View], camera: CameraModel) -> None:
    ours = setup_with(camera)
    paper = setup_with(
        camera,
        detector=DetectorConfig(refinement="subpix"),
        merge=MergeConfig(method="weights"),
    )
    errors: dict[str, list[Array]] = defaultdict(list)
    theirs: dict[str, list[Array]] = defaultdict(list)
    squares: dict[str, list[float]] = defaultdict(list)
    missed: dict[str, int] = defaultdict(int)
    for view in views:
        pose = best_pose(look(ours, view.image))
        if pose is None or pose.level_frame_xyz_yaw_cov is None:
            missed[view.group] += 1
            continue
        # Alone in the picture, the camera counts as level: e is the camera's own frame.
        e = error_of(pose.e_m, pose.e_yaw_rad, view)
        errors[view.group].append(e)
        squares[view.group].append(float(e @ np.linalg.solve(pose.level_frame_xyz_yaw_cov, e)))
        target = look(paper, view.image).target
        if target is not None:
            theirs[view.group].append(error_of(target.e_m, target.e_yaw_rad, view))
    rows = []
    for group, found in errors.items():
        E = np.array(found) * [1e3, 1e3, 1e3, math.degrees(1.0)]
        P = np.array(theirs[group]).reshape(-1, 4) * [1e3, 1e3, 1e3, math.degrees(1.0)]
        other = " ".join(f"{rms(column):.2g}" for column in P.T) if len(P) else "none found"
        size = np.abs(E).max(axis=0)
        rows.append(
            (group, f"{len(E)}/{len(E) + missed[group]}", *(rms(c) for c in E.T),
             float(size[:3].max()), float(size[3]), float(np.mean(squares[group])) / 4.0, other)
        )  # fmt: skip
    table(title, HEAD, rows)
    everything = [s for group in squares.values() for s in group]
    print(
        f"  all: {len(everything)} poses, mean normalised squared error "
        f"{np.mean(everything) / 4.0:.2f} a degree of freedom (median of chi2: 0.84), "
        f"{np.median(everything) / 4.0:.2f} in the median"
    )


def corner_methods() -> dict[str, int]:
    """OpenCV's ways to refine a marker's corners, by name."""
    return {
        "OpenCV": cv2.aruco.CORNER_REFINE_NONE,
        "OpenCV, sub-pixel": cv2.aruco.CORNER_REFINE_SUBPIX,
        "AprilTag, by OpenCV": cv2.aruco.CORNER_REFINE_APRILTAG,
    }


def others(title: str, views: Iterator[View], camera: CameraModel) -> None:
    """Other detectors on the same pictures; both markers' corners are solved as one pose."""
    ours = setup_with(camera)
    errors: dict[tuple[str, str], list[Array]] = defaultdict(list)
    pictures: dict[str, int] = defaultdict(int)
    for view in views:
        reach = "near" if view.tvec[2] < NEAR_M else "far"
        pictures[reach] += 1
        pose = best_pose(look(ours, view.image))
        if pose is not None:
            errors["perchctl", reach].append(error_of(pose.e_m, pose.e_yaw_rad, view))
        for name, method in corner_methods().items():
            found = plain_detect(view.image, method)
            if not found:
                continue
            corners_m = np.vstack([square_corners(SIDES_M[marker]) for marker in found])
            corners_px = np.vstack(list(found.values()))
            _, rvec, tvec = cv2.solvePnP(
                corners_m, corners_px, camera.K, camera.dist, flags=cv2.SOLVEPNP_SQPNP
            )
            rvec, tvec = cv2.solvePnPRefineLM(
                corners_m, corners_px, camera.K, camera.dist, rvec, tvec
            )
            R = cv2.Rodrigues(rvec)[0]
            yaw_rad = math.atan2(R[1, 0], R[0, 0])
            errors[name, reach].append(error_of(np.ravel(tvec), yaw_rad, view))
    rows = []
    for (name, reach), found_errors in sorted(errors.items(), key=lambda item: item[0][::-1]):
        E = np.array(found_errors) * [1e3, 1e3, 1e3, math.degrees(1.0)]
        found_of = f"{len(E)}/{pictures[reach]}"
        medians = " ".join(f"{np.median(np.abs(column)):.2g}" for column in E.T)
        rows.append((f"{name}, {reach}", found_of, *(rms(column) for column in E.T), medians))
    head = ("", "found", "x mm", "y mm", "z mm", "yaw deg", "medians")
    table(title, head, rows)


def rendered(count: int) -> Iterator[View]:
    """Random poses with both markers or the small one in view, lit and spoilt as named."""
    kinds = {
        "clean": (0.6, 1.0, 0.0),
        "noise": (0.8, 8.0, 0.0),
        "blur": (1.8, 3.0, 0.0),
        "gamma": (0.8, 2.0, 1.6),
        "clipped": (0.8, 2.0, -1.45),
    }
    for kind, (defocus, noise, light) in kinds.items():
        scene = renderer(seed=11, camera_noise_sigma=noise)
        rng = np.random.default_rng(list(kind.encode()))
        done = 0
        while done < count:
            z = float(np.exp(rng.uniform(math.log(0.08), math.log(1.2))))
            x, y = (float(v) * z for v in rng.uniform((-0.5, -0.4), (0.5, 0.4)))
            yaw, roll, pitch = (float(v) for v in rng.uniform(-1, 1, 3) * (math.pi, 0.15, 0.15))
            T = camera_pose(x, y, z, yaw, roll, pitch)
            both = in_view(true_corners(T, "large"))
            if not (both or (z < 0.3 and in_view(true_corners(T, "small")))):
                continue
            image = scene.render([T], defocus, done)
            if light > 0.0:
                image = np.rint(255.0 * (image / 255.0) ** (1.0 / light)).astype(np.uint8)
            elif light < 0.0:
                image = np.clip(np.rint(image * -light), 0, 255).astype(np.uint8)
            done += 1
            rvec, tvec = marker_pose(T)
            reach = "near" if z < NEAR_M else "far"
            yield View(f"{kind}, {reach}", image, rvec, tvec)


def path_traced() -> Iterator[View]:
    content = scenes()
    assert content is not None
    for entry in content["frames"]:
        if not entry["target_present"]:
            continue
        tvec = np.array(entry["tvec"])
        kind = entry["category"]
        if kind in ("clean", "noise", "table1", "table2"):
            kind = "clean, noise, tables, " + ("near" if tvec[2] < NEAR_M else "far")
        yield View(kind, scene_picture(entry), np.array(entry["rvec"]), tvec)


def found_in_scenes() -> None:
    content = scenes()
    assert content is not None
    setup = setup_with(content["camera"])
    counts: dict[str, list[int]] = {n: [0, 0, 0] for n in ("large", "small")}
    false = {"ours": 0, "plain": 0, "pictures": 0}
    for entry in content["frames"]:
        image = scene_picture(entry)
        seen, plain = look(setup, image).detections, plain_detect(image)
        if not entry["target_present"]:
            false["pictures"] += 1
            false["ours"] += seen.large is not None or seen.small is not None
            false["plain"] += bool(plain)
            continue
        for name in ("large", "small"):
            if entry[f"{name}_in_view"] and not entry.get("occ"):
                counts[name][0] += 1
                counts[name][1] += getattr(seen, name) is not None
                counts[name][2] += name in plain
    table(
        "Markers found in the path-traced scenes, in view and not occluded",
        ("", "in view", "ours", "two plain detectors"),
        [(name, *row) for name, row in counts.items()]
        + [("false, no target", false["pictures"], false["ours"], false["plain"])],
    )


def main() -> None:
    quick = arguments(__doc__ or "").quick
    count = 25 if quick else 150
    report("Rendered scenes, RMS", rendered(count), CAMERA)
    others("Other detectors, rendered scenes, RMS", rendered(count), CAMERA)
    content = scenes()
    if content is None:
        print("\nThe path-traced scenes are absent (../shared/data/scenes).")
        return
    report("Path-traced scenes, RMS", path_traced(), content["camera"])
    others("Other detectors, path-traced scenes, RMS", path_traced(), content["camera"])
    found_in_scenes()


if __name__ == "__main__":
    main()
