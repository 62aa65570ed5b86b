"""The compiled loops of the model, and how they are compiled."""
