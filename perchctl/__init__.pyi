from .analysis import plot_flight as plot_flight
from .analysis import read_log as read_log
from .calibration import load_calibration as load_calibration
from .camera import FrameSource as FrameSource
from .camera import open_camera as open_camera
from .campaign import simulate as simulate
from .flight import fly_lockstep as fly_lockstep
from .link import VehicleLink as VehicleLink
from .mission import Phase as Phase
from .mission import Severity as Severity
from .mission import Transition as Transition
from .positioning import BodyPose as BodyPose
from .positioning import CaptureFrame as CaptureFrame
from .positioning import CaptureSource as CaptureSource
from .profile import load_profile as load_profile
from .real_time import fly as fly
from .sighting import Sighting as Sighting
from .sighting import track as track
from .vision import Detector as Detector
from .vision import Frame as Frame
from .vision import PipelineState as PipelineState
from .vision import VehicleState as VehicleState
from .vision import estimate as estimate
from .vision import make_pipeline as make_pipeline
from .vision import step as step

__version__: str
