"""A logged flight through today's perception and planner again, as it was or with other values."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
