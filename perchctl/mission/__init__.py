"""The mission as a pure function of state and observation: seven phases, the way down, no clock."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
