"""Flights by the target alone without a known latency: `camera.latency_s: measured`, with cameras
that are faster or slower than the assumed 70 ms, at 10 and 30 pictures a second, in still air and
in a steady wind. Prints how each group of flights ends.
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from statistics import median

from common import table

from perchctl import load_profile, simulate

LATENCIES_S = (0.03, 0.07, 0.11, 0.15, 0.2)
RATES_HZ = (10.0, 30.0)
WINDS_MPS = (0.0, 0.5)
GAP_S = (0.27, 0.67)  # without a picture, once a flight, as `target_only` has at 30 Hz


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=10, help="flights of each group")
    parser.add_argument("--seed", type=int, default=0, help="of the first flight")
    parser.add_argument("--jobs", type=int, default=2, help="flights at a time")
    parser.add_argument("--latency-s", type=float, nargs="*", default=LATENCIES_S)
    parser.add_argument("--rate-hz", type=float, nargs="*", default=RATES_HZ)
    parser.add_argument("--wind-mps", type=float, nargs="*", default=WINDS_MPS)
    args = parser.parse_args()
    rows = []
    with ProcessPoolExecutor(args.jobs) as executor:
        for wind_mps in args.wind_mps:
            for rate_hz in args.rate_hz:
                for latency_s in args.latency_s:
                    profile = load_profile("target_only").with_(
                        {
                            "camera.latency_s": "measured",
                            "simulation.camera_latency_s": [latency_s, latency_s],
                            "simulation.camera_rate_hz": rate_hz,
                            "simulation.camera_burst_frames": [
                                max(1, round(GAP_S[0] * rate_hz)),
                                round(GAP_S[1] * rate_hz),
                            ],
                            "simulation.draught_mps": [wind_mps, wind_mps],
                        }
                    )
                    seeds = range(args.seed, args.seed + args.n)
                    flown = simulate(profile, seeds, executor=executor)
                    misses = [f.miss_m for f in flown if f.miss_m is not None]
                    ends = Counter(f"{f.seed}: {f.reason[:60]}" for f in flown if f.miss_m is None)
                    rows.append(
                        (
                            wind_mps,
                            rate_hz,
                            1e3 * latency_s,
                            f"{len(misses)} of {args.n}",
                            1e3 * median(misses) if misses else float("nan"),
                            "; ".join(ends),
                        )
                    )
                    print(*rows[-1], flush=True)
    table(
        "by the target alone, latency measured in flight",
        ("wind m/s", "pictures/s", "latency ms", "perched", "miss mm", "else"),
        rows,
    )


if __name__ == "__main__":
    main()
