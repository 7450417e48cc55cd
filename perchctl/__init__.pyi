from .analysis import plot_flight as plot_flight
from .calibration import load_calibration as load_calibration
from .flight import fly_lockstep as fly_lockstep
from .log import read_log as read_log
from .profile import load_profile as load_profile
from .vision import Attitude as Attitude
from .vision import Frame as Frame
from .vision import PipelineState as PipelineState
from .vision import estimate as estimate
from .vision import make_pipeline as make_pipeline
from .vision import step as step

__version__: str
