"""From poses to joints: tasks, their placement in the fibre frame, and the controller."""
