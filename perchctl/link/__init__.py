"""The link to a vehicle: what a flight needs of it, by cflib or in lockstep."""
