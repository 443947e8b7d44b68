"""A package whose names are imported on first use."""

from importlib import import_module
from types import ModuleType
from typing import Any


class Lazy(ModuleType):
    """The class of such a package, whose ``_homes`` are the modules of its names."""

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
