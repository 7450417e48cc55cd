"""A page that tells of one flight, or of a session of several, and needs no other file."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
