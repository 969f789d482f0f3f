"""How good plans are, measured by what an agent that follows them does in the true scene."""
