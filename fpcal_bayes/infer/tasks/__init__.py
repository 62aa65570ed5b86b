"""How far a task is off, and what that is made of."""
