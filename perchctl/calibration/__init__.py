"""Calibration of the camera's lens, of its mounting and latency, and of the position of the gear's
tip."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
