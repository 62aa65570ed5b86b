"""Where the joints must go: tasks, and the controller."""
