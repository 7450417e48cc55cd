"""Options of the subcommands whose work is in a file of its own."""
