"""What a template and a threshold belong to: the contract, its levels, the bytes of a template."""
