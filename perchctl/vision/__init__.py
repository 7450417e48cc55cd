"""From a frame to the target's estimate by pure functions: detection, pose, merge and filter.

pipeline: the one way from a picture to the target; its memory is a value.
fields: the two pictures of an interlaced frame.
markers: both markers' corners.
lens: corners without the lens's distortion.
pose: the target's pose and covariance by its corners.
merge: the two ways from two markers to one target.
target_selection: which of several equal targets is the own one.
tracks: the gate, and the poses that a filter takes.
filter: the paper's Kalman filter.
types: the values between these.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
