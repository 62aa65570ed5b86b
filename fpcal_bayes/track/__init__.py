"""How the parameters drift, followed from session to session."""
