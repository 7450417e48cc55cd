"""The paper's merge weights: collect data in a session, fit the weights, and test whether they
help."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
