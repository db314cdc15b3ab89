"""What an adversary can do: the audit's attacks."""
