"""Figures against the papers and the peers: python -m benchmarks.NAME [--quick] [--json]."""
