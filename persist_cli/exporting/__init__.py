"""Whole checkpoints to give away, made of runs."""
