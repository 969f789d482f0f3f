"""Persistent embodied world models from the command line: data, memory, training, rollout and evaluation."""

__version__ = "0.1.0"
