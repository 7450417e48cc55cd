"""Profiles: one YAML file says everything a flight depends on.

schema: the models, each key with its bounds (vision, merge, mission, positioning and simulation
hold the larger sections). worlds: the named sets of the simulation's keys.
load: reading, `extends`, the files a profile names. plain_yaml: what of YAML is read.
old_keys: what earlier versions called them. places: where shipped and the user's files are.
limits: keys that must fit each other. keys: each with its unit, bounds and meaning.
written: as a commented file, and as a schema for editors.
dictionaries: ArUco's ids.
"""

from perchctl.profile.load import (
    find_calibration,
    find_profile,
    find_weights,
    load_profile,
    read_weights,
)
from perchctl.profile.merge import FittedWeights, MergeConfig, WeightsConfig
from perchctl.profile.mission import (
    AlignConfig,
    AscendConfig,
    CompleteConfig,
    EstimateConfig,
    LandingConfig,
    PerchConfig,
    PlannerConfig,
    RecoverConfig,
    SafetyConfig,
    SearchConfig,
)
from perchctl.profile.schema import (
    LinkConfig,
    LogConfig,
    Profile,
)
from perchctl.profile.simulation import SimulationConfig
from perchctl.profile.vision import (
    CameraConfig,
    DetectorConfig,
    KalmanConfig,
    MarkerConfig,
    Mounting,
    PoseConfig,
    TargetConfig,
    VehicleConfig,
)

__all__ = [
    "AlignConfig",
    "AscendConfig",
    "CameraConfig",
    "CompleteConfig",
    "DetectorConfig",
    "EstimateConfig",
    "FittedWeights",
    "KalmanConfig",
    "LandingConfig",
    "LinkConfig",
    "LogConfig",
    "MarkerConfig",
    "MergeConfig",
    "Mounting",
    "PerchConfig",
    "PlannerConfig",
    "PoseConfig",
    "Profile",
    "RecoverConfig",
    "SafetyConfig",
    "SearchConfig",
    "SimulationConfig",
    "TargetConfig",
    "VehicleConfig",
    "WeightsConfig",
    "find_calibration",
    "find_profile",
    "find_weights",
    "load_profile",
    "read_weights",
]
