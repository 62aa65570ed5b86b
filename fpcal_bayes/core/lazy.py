"""Names that a room loads from its modules when they are first used, so that the room costs nothing to import."""

import sys
from collections.abc import Callable, Mapping
from functools import wraps
from importlib import import_module
from inspect import isfunction, signature
from types import UnionType
from typing import Any, get_args

from fpcal_bayes.core.errors import InputError


def lazy(package: str, names: Mapping[str, str]) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """``__all__``, ``__getattr__`` and ``__dir__`` of a package: `names` of each of its modules, apart by spaces."""
    places = {name: module for module, held in names.items() for name in held.split()}

    def load(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = getattr(import_module(f"{package}.{places[name]}"), name)
        if "." not in package and isfunction(found):
            found = _checked(found)
            found.__module__ = package  # where it is found when it is sent to another process
        setattr(sys.modules[package], name, found)
        return found

    return sorted(places), load, lambda: sorted(places)


def _checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which refuses what is none of this package's objects that it asks for, in one sentence."""
    parameters = signature(function).parameters
    kinds = {
        name: each.annotation
        for name, each in parameters.items()
        if isinstance(each.annotation, type | UnionType) and "fpcal_bayes." in str(each.annotation)
    }

    @wraps(function)
    def call(*given: Any, **named: Any) -> Any:
        for name, value in (*zip(parameters, given, strict=False), *named.items()):
            if name in kinds and not isinstance(value, kinds[name]):
                wanted = (get_args(kinds[name]) or (kinds[name],))[0].__name__
                raise InputError(f"{function.__name__}: {name} is of type {type(value).__name__}, expected {wanted}")
        return function(*given, **named)

    return call
