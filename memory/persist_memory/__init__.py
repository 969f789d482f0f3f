"""Memories of a scene and their encoders (entry points: persist.memories, persist.encoders)."""
