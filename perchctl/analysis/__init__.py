"""Analysis of flight logs: shown, compared, drawn, reported, and replayed."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
