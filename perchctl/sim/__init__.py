"""The simulated vehicle, its room and its camera, which advance in simulated time."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
