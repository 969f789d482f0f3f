"""Editing by hand: how edits are written, the command, its pictures, and where an edit can be seen."""
