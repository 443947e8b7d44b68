"""A package whose names are imported on first use."""

import ast
import inspect
import sys
from importlib import import_module
from types import ModuleType
from typing import Any


def on_first_use(package: str) -> None:
    """Makes the names that the package's source imports from its submodules, for type checkers, its attributes."""
    module = sys.modules[package]
    source = ast.parse(inspect.getsource(module))
    imports = [node for node in ast.walk(source) if isinstance(node, ast.ImportFrom)]
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}
    module.__dict__["_homes"] = {name: homes[name] for name in module.__all__}
    module.__class__ = _Lazy


class _Lazy(ModuleType):
    _homes: dict[str, str]

    def __getattr__(self, name: str) -> Any:
        if name not in self._homes:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        value = self.__dict__[name] = getattr(import_module(self._homes[name]), name)
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # Importing a submodule binds its name in the package, where the function of that name (render) stands.
        if not (name in self._homes and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*self._homes, *(name for name in self.__dict__ if name.startswith("__"))})
