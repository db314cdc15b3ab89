"""What a request may cost: admission before allocation, and rate limits."""
