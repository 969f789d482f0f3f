"""The one error family: whatever a user can cause ends in one line and exit code 1."""


class PersistError(Exception):
    """Something the user can mend; its message is one line that says what is wrong and what to do."""


class DataError(PersistError):
    """A data set, trajectory, image or pose that cannot be used; names the file and the cause."""


class PluginError(PersistError):
    """A plugin that is unknown, broken, or of the wrong kind; names plugin, package and cause."""


class RecipeError(PersistError):
    """A recipe or setting that cannot be used; names every wrong key at once."""


class CheckpointError(PersistError):
    """A checkpoint, adapter or memory file that is missing, corrupt, or does not fit."""
