"""The running service: what it opens, its logs, metrics and health."""
