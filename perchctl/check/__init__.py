"""What can be known on the ground before a flight: one row for each question."""
