"""The policies that come with persist; all else reaches them by the registry of plugins."""
