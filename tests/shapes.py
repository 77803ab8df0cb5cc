"""The type checker that the suite runs under: shapes and types of annotations are checked at every call."""

import ast
import functools
import inspect

import jax
import numpy as np
from beartype import BeartypeConf, beartype
from jaxtyping import _import_hook, install_import_hook

_check = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""An int passes for a float, as in static type checking."""


def checked(function):
    """The function with its arguments and its result checked; used by jaxtyping's import hook.

    JAX rebuilds registered dataclasses from leaves of any type, as from booleans of a mask or from placeholders. Such
    a call of `__init__` is let through; every other one is checked.
    """
    strict = _check(function)
    if function.__name__ != "__init__":
        return strict
    arrays = {name for name, kind in function.__annotations__.items() if "Array" in str(kind) or "ndarray" in str(kind)}
    names = function.__code__.co_varnames[1 : function.__code__.co_argcount]

    @functools.wraps(function)
    def initialise(self, *args, **kwargs):
        given = dict(zip(names, args, strict=False)) | kwargs
        if "check_hyperparameters" in _names_in(getattr(self, "__post_init__", None)):
            return function(self, *args, **kwargs)  # it refuses wrong types itself, in its own words
        leaves = [given[name] for name in arrays & given.keys()]
        rebuilt = any(type(leaf) in (bool, object) or _is_placeholder(leaf) for leaf in leaves)
        return (function if rebuilt else strict)(self, *args, **kwargs)

    return initialise


def _names_in(method) -> tuple[str, ...]:
    """The global names that a method uses."""
    return () if method is None else inspect.unwrap(method).__code__.co_names


def _is_placeholder(value) -> bool:
    """Whether a leaf stands for an array without being one."""
    return not isinstance(value, jax.Array | np.ndarray | np.generic | int | float | tuple | list)


class _OutermostFunctions(_import_hook.JaxtypingTransformer):
    """Leaves functions within functions as they are.

    They are made anew at every call, and their checkers would be compiled anew with them: half of the suite's time.
    """

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        within = any(isinstance(parent, ast.FunctionDef) for parent in self._parents)
        return node if within else super().visit_FunctionDef(node)


def check(package):
    """Check every call of the functions and methods of a package that is imported from now on."""
    _import_hook.JaxtypingTransformer = _OutermostFunctions  # there is no public way to choose functions
    install_import_hook(package, "shapes.checked")
