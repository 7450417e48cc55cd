"""The simulated Crazyflie's end of the link: its ports, tables and the UDP carrier."""
