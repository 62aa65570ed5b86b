"""From poses to joints: tasks, their placement in the fibre frame, and the controller."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "Controller": "controller",
    "compensated": "compensation",
    "TASKS": "tasks",
    "Task": "tasks",
    "task_path": "tasks",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
