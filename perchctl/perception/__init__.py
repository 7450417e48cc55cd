"""Estimate the target's pose from frames and telemetry, in the same way for every command."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
