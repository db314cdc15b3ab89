"""The private template: subspaces, lifting, decoys, distances, contract, storage."""
