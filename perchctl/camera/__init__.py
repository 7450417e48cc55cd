"""Cameras, streams, videos and pictures as sources of frames, and the health of what they give."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
