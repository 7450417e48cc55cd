"""The printed target and the calibration boards: sizes, drawings, PDF, and what a camera sees."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
