"""From poses to joints: tasks, their placement in the fibre frame, and the controller."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {"compensation": "compensated", "controller": "Controller", "tasks": "TASKS Task task_path"}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
