"""Campaigns of many seeded flights in lockstep, flown in processes or on a cluster, counted and
compared."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
