"""The simulated vehicle, its room and its camera, stepped by simulated time."""
