"""Several vehicles in one room: the fleet file, the radio budget, corridors, and the order of
flight.

Everything here is a pure function of the fleet file and the profiles that it names: nothing is
connected, opened or armed.

    fleet = load_fleet("atrium.yaml")     # Fleet of FleetVehicle, each with an ordinary Profile

load: the file, and refusals of what two vehicles must not share. fleet: the frozen values.
assignment: interchangeable targets. dongles: which Crazyradio carries whom.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
