"""Measurements that the pages quote: ``python -m benchmarks NAME`` prints one table each."""
