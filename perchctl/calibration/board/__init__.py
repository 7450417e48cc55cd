"""Calibration of the lens from pictures of a printed board."""
