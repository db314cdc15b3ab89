"""Keys and secrets: sealing, key files, rotations, randomness."""
