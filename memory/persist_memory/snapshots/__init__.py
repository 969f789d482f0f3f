"""The memory of image snapshots."""
