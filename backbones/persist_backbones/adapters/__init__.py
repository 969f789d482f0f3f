"""Memory adapters: the modules by which the tokens of a memory change the video."""
