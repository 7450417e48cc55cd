from .fleet_panel import FleetPanel as FleetPanel
from .fleet_panel import FleetRow as FleetRow
from .live import LivePage as LivePage
from .live import Sketch as Sketch
from .live import live_page as live_page
from .live import make_sketch as make_sketch
from .page import FlightPage as FlightPage
from .panel import FlightPanel as FlightPanel
