"""Scans of a sensor that nothing in the tree knows."""
