"""Tests; the checks shared by several files are modules here (tests.involution)."""
