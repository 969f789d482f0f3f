"""The memory of cells that also imagines, evolves and is edited."""
