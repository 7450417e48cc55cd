"""The link to a vehicle: through cflib, or to the simulated vehicle in lockstep."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
