"""Output for people: the console, listings, videos, contact sheets and maps."""
