"""Profiles: one YAML file says everything a flight depends on.

schema: the whole; vision, mission, positioning and simulation hold the sections, each key with
its bounds. limits: keys that must fit each other.
load: reading, `extends`, the files of weights, calibration and mask. edit: changes, in
memory and in the file. keys: each with its unit, bounds and meaning, as a commented file, and as
a schema for editors. base: what all sections share, and keys that have become constants.
dictionaries: ArUco's.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
