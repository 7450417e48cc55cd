"""A simulated motion-capture system: what its cameras see, and its server on loopback."""
