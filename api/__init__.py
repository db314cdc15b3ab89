"""The ways in: REST, the command line, settings."""
