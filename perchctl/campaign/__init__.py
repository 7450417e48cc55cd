"""Campaigns: fly many seeded flights in lockstep, in processes or on a cluster, and count and
compare their outcomes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
