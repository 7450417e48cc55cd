"""Estimate the target from frames and telemetry: the one session that every command uses."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
