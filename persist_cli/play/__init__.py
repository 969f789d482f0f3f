"""``persist play``: a page to walk in with the keys through what a world model imagines."""
