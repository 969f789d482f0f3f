"""Policy learning inside the model: an agent practises in a new house that it knows from a few posed images."""
