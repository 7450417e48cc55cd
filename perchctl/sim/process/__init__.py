"""The simulated vehicle as a process of its own: handle, messages, child, pace."""
