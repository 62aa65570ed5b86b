"""One cell, forwards and backwards: from parameters and joints to the cavity length, and from a pose to joints."""
