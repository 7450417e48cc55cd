"""The seven phases of the mission and its descent: pure functions of state and observation."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
