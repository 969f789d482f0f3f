"""Rollouts of the world model, whose loop is: recall, denoise, observe, memorize."""
