"""How good imagined scenes are, measured in houses whose cells are known."""
