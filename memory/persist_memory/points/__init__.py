"""A memory of points that are not pooled."""
