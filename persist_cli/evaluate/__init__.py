"""``persist eval``: checkpoints, memories and controls on equal clips, with metrics that say what they measure."""
