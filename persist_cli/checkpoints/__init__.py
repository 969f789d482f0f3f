"""Checkpoints: found, loaded, saved and exported, with what they came from."""
