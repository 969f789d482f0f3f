"""The world model loop: recall, denoise, observe, memorize."""
