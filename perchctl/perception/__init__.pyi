from .history import History as History
from .history import add_samples as add_samples
from .history import attitude_at as attitude_at
from .perception import MIRRORED_FRAMES as MIRRORED_FRAMES
from .perception import Perception as Perception
