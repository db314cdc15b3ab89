"""Compiled kernels for tiles of the cross-Gram matrix; ``templates.tiles`` feeds them."""
