"""The parameters from session to session."""
