"""Weights of encoders and metrics: what there is, where each can come from, and bringing it here verified."""
