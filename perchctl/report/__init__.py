"""A flight, or a session of them, told afterwards on one page that needs nothing else."""
