"""The phases of a mission, one file each: entry, action, exits, and their constants."""
