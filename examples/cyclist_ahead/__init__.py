"""A street and a driver outside the tree, and one planning cycle from plain arrays."""
