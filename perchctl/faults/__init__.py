"""Faults injected into simulated flights, and the oracle that judges flights by the true state."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
