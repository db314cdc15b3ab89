"""The REST service: requests, answers, errors and routes."""
