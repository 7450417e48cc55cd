"""Cameras, streams, videos and images as sources of frames, and their health."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
