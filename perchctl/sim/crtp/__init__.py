"""The Crazyflie's side of CRTP: its tables and its server."""
