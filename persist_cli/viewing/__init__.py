"""Pictures for people: videos, contact sheets, maps, curves, tables."""
