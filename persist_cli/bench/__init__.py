"""Benchmarks of plans and collisions against a simulator's own truth."""
