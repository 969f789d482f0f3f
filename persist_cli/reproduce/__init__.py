"""The demos: ``persist`` from end to end, by the commands that a user would type."""
