"""Comparison of memories on clips that return to places seen before."""
