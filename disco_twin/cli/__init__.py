"""The command line: what a user types, and the errors that it answers with."""
