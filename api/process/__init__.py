"""What calibration and setup do, before a service can start."""
