"""Benchmarks of plans, collisions and imagined scenes against a simulator's own truth."""
