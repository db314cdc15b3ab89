"""Compiled kernels for tiles of the cross-Gram matrix; ``templates.distances.tiles`` feeds them."""
