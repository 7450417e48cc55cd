"""Profiles: one YAML file contains everything that a flight depends on.

The module `schema` contains the whole profile; `vision`, `mission`, `positioning` and `simulation`
contain its sections, with the bounds of each key. `limits` checks keys that must be consistent with
each other. `load` reads a profile, resolves `extends`, and finds the files for weights, calibration
and mask. `edit` changes a profile in memory or in its file. `keys` describes each key with its
unit, bounds and meaning, as a commented file or as a schema for editors. `base` contains the parts
that all sections share, and handles keys that have become constants. The module `vision` also
contains the ArUco dictionaries.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
