"""Where the vehicle's estimate gets its place from, when its decks do not give it."""
