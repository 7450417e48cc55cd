"""The simulated vehicle as a process of its own: handle, child, host."""
