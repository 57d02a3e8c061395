"""Wires models, engines, scenarios, figures and reports; the only place that knows them all."""
