from .fleet import Fleet as Fleet
from .fleet import FleetVehicle as FleetVehicle
from .load import EXAMPLE as EXAMPLE
from .load import find_fleet as find_fleet
from .load import load_fleet as load_fleet
