"""The mathematics of a template: affine subspaces, their dual form, and lifting."""
