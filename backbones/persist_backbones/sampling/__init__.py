"""How clips are drawn: samplers, guidance, caches over steps, and where weights rest meanwhile."""
