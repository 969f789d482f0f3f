"""Rows of the table: models with a memory, and controls that need no training."""
