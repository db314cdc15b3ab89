"""One server process: settings to opened things, workers, logs, metrics, health."""
