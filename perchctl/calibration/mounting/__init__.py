"""Measure the camera's rotation in the vehicle, the latency of its images, and the position of the
gear's tip, while the vehicle is moved by hand with the target in view."""
