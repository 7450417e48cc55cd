"""Profiles: one YAML file says everything a flight depends on.

schema: the models, each key with its bounds (vision, merge, mission, positioning and simulation
hold the larger sections). worlds: the named sets of the simulation's keys.
load: reading, `extends`, the files a profile names. plain_yaml: what of YAML is read.
old_keys: what earlier versions called them. places: where shipped and the user's files are.
limits: keys that must fit each other. keys: each with its unit, bounds and meaning.
written: as a commented file, and as a schema for editors.
dictionaries: ArUco's ids.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
