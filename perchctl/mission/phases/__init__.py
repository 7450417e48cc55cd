"""The phases of a mission: one module each, with its entry, action, exits and constants."""
