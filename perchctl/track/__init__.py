"""The target followed in any camera, video or folder of pictures, without a vehicle."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
