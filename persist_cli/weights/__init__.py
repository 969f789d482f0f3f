"""Weights of encoders and metrics: a catalog, sources, and a cache of verified files."""
