"""Memory adapters: how tokens of a memory reach the video."""
