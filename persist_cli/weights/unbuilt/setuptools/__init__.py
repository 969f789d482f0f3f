"""A replacement for setuptools while pip downloads an archive that is read and never built."""
