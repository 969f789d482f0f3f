"""Building, loading and merging memory files."""
