"""Compute once per tick what the planner believes about the vehicle, without phases or
decisions."""
