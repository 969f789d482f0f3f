"""``persist recipes``: the recipes that come with persist."""

from __future__ import annotations

from persist_cli.recipe import make_recipe, read_recipe, recipe_names
from persist_cli.viewing.console import print_json, print_table


def show_recipes(json: bool) -> None:
    """Name, stage, memory and description of each."""
    recipes = [(name, make_recipe(read_recipe(name), name)) for name in recipe_names()]
    rows = [[name, each.stage, each.memory.name if each.memory else "", each.description] for name, each in recipes]
    if json:
        print_json([dict(zip(("name", "stage", "memory", "description"), row, strict=True)) for row in rows])
    else:
        print_table("Recipes", ("name", "stage", "memory", "description"), rows)
