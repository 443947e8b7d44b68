"""Safetensors files: tensors and metadata."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import safe_open

from clod_adapter.errors import ClodError
from clod_adapter.io.sniff import read_start, refuse_known, utf8_name

if TYPE_CHECKING:
    from torch import Tensor


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and the metadata of a file; raises OSError, or on damage whatever safetensors does."""
    with _opened(path, "pt") as file:
        # Copies, since the file may change under a memory map.
        return {name: file.get_tensor(name).clone() for name in file.keys()}, file.metadata() or {}  # noqa: SIM118


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and the metadata of an input file.

    Raises:
        ClodError: it cannot be read, is something else, or damaged.
    """
    with _one_line_errors(path):
        return read_tensors(path)


def read_tensor_metadata(path: Path) -> dict[str, str]:
    """The metadata alone, without torch.

    Raises:
        ClodError: as ``load_tensors``.
    """
    with _one_line_errors(path), _opened(path, "np") as file:
        return file.metadata() or {}


@contextmanager
def _opened(path: Path, framework: str) -> Iterator[Any]:
    with utf8_name(path) as name, safe_open(name, framework=framework) as file:
        yield file


@contextmanager
def _one_line_errors(path: Path) -> Iterator[None]:
    refuse_known(path, read_start(path))
    try:
        yield
    except OSError as error:
        raise ClodError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    except MemoryError:  # of a file that is whole
        raise
    except Exception as error:  # SafetensorError, and whatever a crafted header provokes
        raise ClodError(f"{path}: is not a safetensors file, or damaged ({error}); copy or export it again") from error
