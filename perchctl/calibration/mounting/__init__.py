"""Measure the camera's rotation in the vehicle, the latency of its images, and the position of
the gear's tip, with a vehicle that is moved by hand in view of the target."""
