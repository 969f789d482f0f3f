"""The demos: ``persist`` from end to end, by the commands that a user would type."""

import os

from persist_cli.cli.options import limit_spinning

limit_spinning(os.environ)  # before a module beside this one imports torch
