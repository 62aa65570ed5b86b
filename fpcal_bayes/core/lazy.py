"""Names that a room loads from its modules when they are first used, so that the room costs nothing to import."""

import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import wraps
from importlib import import_module
from inspect import isfunction, signature
from numbers import Integral, Real
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


#: Kinds of arguments that are none of this package's objects, in words.
_PLAIN: dict[Any, str] = {int: "a whole number", float: "a number", Sequence[str]: "a list of names"}


def _checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which refuses in one sentence what is none of the objects, numbers and names that it asks for."""
    parameters, wanted = signature(function).parameters, {}
    for name, each in parameters.items():
        kinds = get_args(each.annotation) if isinstance(each.annotation, UnionType) else (each.annotation,)
        if kinds[0] in _PLAIN or "fpcal_bayes." in str(each.annotation):
            wanted[name] = kinds

    def read(name: str, value: Any) -> Any:
        kinds = wanted.get(name, (object,))
        if not any(_fits(value, kind) for kind in kinds):
            expected = (_PLAIN.get(kinds[0]) or kinds[0].__name__) + " or an array" * ("NDArray" in str(kinds[1:]))
            raise InputError(f"{function.__name__}: {name} is of type {type(value).__name__}, expected {expected}")
        if name == "seed" and value is not None and value < 0:
            raise InputError(f"{function.__name__}: seed {value}: expected zero or more")
        # Numpy's whole numbers become Python's own, which do not overflow.
        return int(value) if kinds[0] is int and value is not None else value

    @wraps(function)
    def call(*given: Any, **named: Any) -> Any:
        known = [read(name, value) for name, value in zip(parameters, given, strict=False)]
        return function(*known, *given[len(known) :], **{name: read(name, value) for name, value in named.items()})

    return call


def _fits(value: Any, kind: Any) -> bool:
    if kind == Sequence[str]:
        return isinstance(value, Collection) and not isinstance(value, str) and all(isinstance(v, str) for v in value)
    of_array = getattr(getattr(value, "dtype", None), "kind", None)
    if "NDArray" in str(kind):
        several = isinstance(value, list | tuple) and all(_fits(v, kind) for v in value)
        return several or (_fits(value, float) if of_array is None else of_array in "iuf")
    if kind in (int, float) and of_array is not None:
        return bool(value.ndim == 0 and of_array in ("iu" if kind is int else "iuf"))
    if kind in _PLAIN:
        return isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
    return not isinstance(kind, type) or isinstance(value, kind)
