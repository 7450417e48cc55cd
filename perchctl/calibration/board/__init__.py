"""Calibration of the lens from images of a printed board."""
