"""Estimate the target from a frame with pure functions: detection, pose, merge and filter.

pipeline: processes one frame, from the image to the target estimate; takes and returns its state.
fields: deinterlaces the frames of analogue cameras.
markers: detects the corners of both markers.
lens: removes the lens distortion from corners.
pose: computes the target's pose and its covariance from corners.
merge: combines the two markers into one target, by one of two methods.
target_selection: selects the vehicle's own target from several identical ones.
tracks: gates the poses and updates the filters.
filter: the paper's Kalman filter.
types: the values that these modules exchange.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
