"""Estimate the target from a frame with pure functions: detection, pose, merge and filter.

pipeline: the only path from an image to the target; its memory is a value.
fields: the two images of an interlaced frame.
markers: detection of the corners of both markers.
lens: removal of the lens distortion from corners.
pose: pose and covariance of the target from its corners.
merge: the two methods that combine two markers into one target.
target_selection: choice of the own target among several identical ones.
tracks: the gate, and the poses that update a filter.
filter: the paper's Kalman filter.
types: the values that these modules exchange.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
