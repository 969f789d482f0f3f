"""Recipes in YAML, read with importlib.resources."""
