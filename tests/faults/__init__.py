"""Tests of `perchctl.faults`."""
