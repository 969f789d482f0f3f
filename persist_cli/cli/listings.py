"""``persist plugins`` and ``persist recipes``: signatures only; what they show is imported when they run."""

from __future__ import annotations

from persist_cli.cli.options import JsonOption


def plugins(json: JsonOption = False) -> None:
    """List every backbone, memory, encoder, simulator and importer; a broken one shows its cause."""
    from persist_cli.viewing.listings import show_plugins

    show_plugins(json)


def recipes(json: JsonOption = False) -> None:
    """List the recipes that come with persist."""
    from persist_cli.viewing.listings import show_recipes

    show_recipes(json)
