"""Scenes to learn from: simulated, or read from files."""
