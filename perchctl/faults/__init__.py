"""Faults laid into simulated flights, and the oracle that judges by the world's truth."""
