"""What a recipe needs, found out before anything is loaded: parameters, memory, and what would fit."""
