"""A simulated device: it wraps CPU tensors, and operations that would fail on a GPU fail on it.

Mixing its tensors with the CPU's in one operation, ``.numpy()``, and indexing the CPU's with its
own are refused; 0-d CPU tensors mix, as on CUDA. It is torch's private backend under the name
``gpu``, which is neither "cpu" nor "cuda". ``waits`` tells where the host would wait for the
device.
"""

from __future__ import annotations

import traceback
from contextlib import contextmanager
from functools import lru_cache

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

MOVES = ("aten._to_copy.default", "aten.copy_.default")  # what may see tensors of both
# of operations whose result, or its size, the host reads
READS = {torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape}
_log = []


class Walled(Tensor):
    """A tensor of the device; ``inner`` is the CPU tensor."""

    inner: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, real):
        made = Tensor._make_wrapper_subclass(
            cls,
            real.shape,
            strides=real.stride(),
            storage_offset=real.storage_offset(),
            dtype=real.dtype,
            device=torch.device("gpu", 0),
        )
        made.inner = real
        return made

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return _run(function, args, kwargs or {})


def _run(function, args, kwargs):
    tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)]
    walled = [x for x in tensors if isinstance(x, Walled)]
    outside = [x for x in tensors if not isinstance(x, Walled) and x.dim()]
    if walled and outside and str(function) not in MOVES:
        raise RuntimeError(
            f"{function}: tensors of the fake GPU and of the CPU,"
            f" {[tuple(x.shape) for x in outside]}"
        )
    if _waits(function, args, kwargs, walled):
        _log.append(_place())
    device = kwargs.get("device")
    inside = bool(walled) if device is None else torch.device(device).type == "gpu"
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    args, kwargs = tree_map(lambda x: x.inner if isinstance(x, Walled) else x, (args, kwargs))
    own = {id(x.inner): x for x in walled}  # an operation in place returns what it was given
    out = function(*args, **kwargs)
    if not inside:
        return out
    return tree_map(
        lambda x: own[id(x)] if id(x) in own else Walled(x) if isinstance(x, Tensor) else x, out
    )


def _waits(function, args, kwargs, walled):
    """Whether the host waits for the device: it reads a value or a size, or copies and is not told
    to go on.
    """
    name = str(function)
    if name in MOVES:
        to = torch.device(kwargs.get("device") or args[0].device)
        going_on = kwargs.get("non_blocking") or (name == MOVES[1] and args[2:] == (True,))
        return (to.type == "gpu") != bool(
            walled if name == MOVES[0] else isinstance(args[1], Walled)
        ) and not going_on
    if name.startswith("aten.index"):  # by masks alone
        return any(each.dtype == torch.bool for each in walled[1:])
    return bool(walled) and not READS.isdisjoint(function.tags)


def _place():
    """The innermost function of the package, as ``training/trainer.py:step``."""
    for frame in reversed(traceback.extract_stack()):
        _, inside, file = frame.filename.rpartition("/clod_adapter/")
        if inside:
            return f"{file}:{frame.name}"
    return "outside"


@contextmanager
def waits():
    """The places at which the host waits for the device within the context, once for each time."""
    _log.clear()
    yield _log


class _Dispatch(TorchDispatchMode):
    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        return _run(function, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """Handles calls that dispatch does not see: ``torch.tensor`` with a device, and ``tolist``."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function is torch.tensor and kwargs.get("device") is not None:
            device = kwargs.pop("device")
            return function(*args, **kwargs).to(device)
        if function is Tensor.tolist:
            return args[0].cpu().tolist()
        return function(*args, **kwargs)


@lru_cache(maxsize=1)
def register():
    """Whether this torch has devices written in Python; registers this one, unless there is a real
    GPU: before the first backward pass, when autograd starts a thread per device.
    """
    if torch.cuda.is_available():
        return True
    try:
        from torch.utils.backend_registration import (
            _DummyBackendModule,
            _setup_privateuseone_for_python_backend,
        )
    except ImportError:
        return False

    class Module(_DummyBackendModule):
        # torch.autocast asks for it, to be disabled too
        def get_amp_supported_dtype(self):
            return [torch.float16, torch.bfloat16]

    _setup_privateuseone_for_python_backend("gpu", Module())
    return True


@contextmanager
def fake_gpu():
    """The device, within the context; skips where torch does not support it."""
    if not register():
        pytest.skip("this torch has no devices that are written in Python")
    with _Dispatch(), _Functions():
        yield torch.device("gpu", 0)
