"""Position sources for a vehicle without a deck: a motion-capture system, or the target itself."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
