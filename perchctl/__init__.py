"""perchctl: hang a Crazyflie onto a ceiling by the sight of a printed target.

The names below are the public ones, for notebooks and scripts; `docs/python.md` shows them
at work. They are loaded when they are first used, so that the command line starts at once.
"""

from importlib import import_module

__version__ = "0.2.0"

TYPE_CHECKING = False  # typing's own takes longer to load than all of this

if TYPE_CHECKING:
    from perchctl.analysis import plot_flight
    from perchctl.calibration import load_calibration
    from perchctl.flight import fly_lockstep
    from perchctl.log import read_log
    from perchctl.profile import load_profile
    from perchctl.vision import Attitude, Frame, PipelineState, estimate, make_pipeline, step

_HOMES = {
    "Attitude": "perchctl.vision.types",
    "Frame": "perchctl.vision.types",
    "PipelineState": "perchctl.vision.types",
    "estimate": "perchctl.vision.pipeline",
    "fly_lockstep": "perchctl.flight.lockstep",
    "load_calibration": "perchctl.calibration.files",
    "load_profile": "perchctl.profile",
    "make_pipeline": "perchctl.vision.pipeline",
    "plot_flight": "perchctl.analysis.plot",
    "read_log": "perchctl.log.read",
    "step": "perchctl.vision.pipeline",
}

__all__ = [
    "Attitude",
    "Frame",
    "PipelineState",
    "__version__",
    "estimate",
    "fly_lockstep",
    "load_calibration",
    "load_profile",
    "make_pipeline",
    "plot_flight",
    "read_log",
    "step",
]


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'perchctl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
