"""Estimates before a training: its parameters, the memory that it needs, and what makes it fit a machine."""
