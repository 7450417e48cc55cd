"""Named worlds to simulate in: what `simulation.set` puts in the place of the keys' defaults.

`nominal` is the schema's defaults as they stand. The others are harder in everything that a
flight has to cope with, each value within what is known of Crazyflies, rooms and cameras
(docs/campaigns.md, "Harder worlds").
"""

from __future__ import annotations

from typing import Any

NOMINAL = "nominal"

WORLDS: dict[str, dict[str, Any]] = {
    NOMINAL: {},
    "rough": {
        "mass_kg": (0.042, 0.045),
        "battery_rest_v": (4.0, 4.2),
        "cell_resistance_ohm": (0.143, 0.17),
        "cell_slow_ohm": (0.0, 0.03),
        "cell_charge": (0.8, 1.0),
        "cell_knee": (0.07, 0.13),
        "draught_mps": (0.2, 0.5),
        "gust_mps": (0.1, 0.3),
        "ceiling_suction": (0.1, 0.2),
        "target_tilt_deg": (0.0, 1.5),
        "gloss": (0.2, 0.8),
        "camera_readout_s": 0.01,
        "camera_analogue": 0.15,
        "flow_noise_radps": (0.02, 0.05),
        "flow_bias_dps": (0.1, 0.4),
        "flow_reach_m": 2.5,
        "bare_floor_m": (0.1, 0.3),
        "radio_loss": (0.0, 0.03),
        "radio_burst_s": (0.05, 0.15),
        "capture_hole_s": (0.2, 1.0),
    },
    "extreme": {
        "ceiling_z_m": (1.8, 2.8),
        "mass_kg": (0.044, 0.045),
        "battery_rest_v": (3.9, 4.2),
        "cell_resistance_ohm": (0.15, 0.19),
        "cell_slow_ohm": (0.0, 0.05),
        "cell_charge": (0.5, 0.9),
        "cell_knee": (0.07, 0.15),
        "draught_mps": (0.4, 0.8),
        "gust_mps": (0.2, 0.6),
        "ceiling_suction": (0.1, 0.3),
        "target_tilt_deg": (1.0, 3.0),
        "gloss": (0.5, 2.0),
        "camera_readout_s": 0.02,
        "camera_analogue": 0.4,
        "flow_noise_radps": (0.05, 0.15),
        "flow_bias_dps": (0.3, 1.0),
        "flow_reach_m": 2.5,
        "bare_floor_m": (0.2, 0.6),
        "radio_loss": (0.02, 0.08),
        "radio_burst_s": (0.1, 0.3),
        "capture_hole_s": (1.0, 1.0),
        "capture_hole_every_s": 8.0,
    },
}


def with_world(values: dict[str, Any]) -> dict[str, Any]:
    """The simulation's keys on top of what their `set` has; an unknown one adds nothing, and is
    refused by the schema."""
    name = values.get("set", NOMINAL)
    return (WORLDS.get(name, {}) if isinstance(name, str) else {}) | values
