"""The REST calls, one module for each thing that a client does."""
