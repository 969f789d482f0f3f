"""Built-in importers of foreign posed RGB-D formats."""
