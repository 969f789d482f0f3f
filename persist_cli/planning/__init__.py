"""Planning inside the model: candidates, what they would see, and which of them comes nearest to the goal."""
