"""``python -m persist_cli`` is ``persist``, for launchers that start modules."""

from persist_cli.cli.app import main

main()
