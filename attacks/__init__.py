"""What an adversary can do to private templates, and the report that tells an operator."""
