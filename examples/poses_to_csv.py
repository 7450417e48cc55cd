"""Poses of all pictures of a folder, as a CSV: python poses_to_csv.py FOLDER CALIBRATION CSV"""

import csv
import math
import sys
from pathlib import Path

from perchctl import load_profile, track

COLUMNS = ("picture", "x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m", "yaw_deg", "note")


def write_poses(folder: str, calibration: str, csv_file: Path) -> int:
    """Write a line for each picture; returns in how many of them the target was found."""
    # The printed sizes, outer edges; `perchctl make-target measured` helps to measure them.
    profile = load_profile("sim").with_(
        {"target.large.side_m": 0.150, "target.small.side_m": 0.025}
    )
    found = 0
    with csv_file.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for seen in track(f"images:{folder}", profile, calibration):
            T, cov = seen.T_cam_target, seen.covariance
            if T is None or cov is None:
                table.writerow([seen.name, *[""] * 7, seen.note])
                continue
            found += 1
            sigmas_m = cov.diagonal()[:3] ** 0.5
            yaw_deg = math.degrees(math.atan2(T[1, 0], T[0, 0]))
            table.writerow([seen.name, *T[:3, 3], *sigmas_m, yaw_deg, seen.note])
    return found


if __name__ == "__main__":
    print(write_poses(sys.argv[1], sys.argv[2], Path(sys.argv[3])), "pictures show the target")
