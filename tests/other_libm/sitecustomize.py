"""Another machine's elementary functions: their results differ from this machine's by one unit in
the last place.

    OTHER_LIBM=0 PYTHONPATH=tests/other_libm python -m pytest tests/equation

The value of OTHER_LIBM is a seed, which says for each result whether it moves up or down; equal
results move alike. Powers of two, whole numbers below 1024, infinities and NaN stay, so no sigmoid
exceeds 1. ``math``, NumPy's functions and torch's on the CPU are moved, each in its own way, as
libraries differ; the kernels' are polynomials of their own. Python runs this file at its start,
also in processes that a test starts.
"""

import importlib.machinery
import math
import os
import sys
import warnings
import zlib
from functools import wraps
from pathlib import Path

SEED = os.environ.get("OTHER_LIBM")
# smaller whole numbers and powers of two are exact everywhere: log2(8), exp(0), sigmoid(0)
WHOLE = 1024
COMMON = "exp exp2 expm1 log log2 log10 log1p sin cos tan sinh cosh tanh"
MATH = f"{COMMON} pow asin acos atan atan2".split()
NUMPY = f"{COMMON} arcsin arccos arctan arctan2 hypot logaddexp".split()
OF_TORCH = "pow asin acos atan atan2 hypot logaddexp sigmoid log_sigmoid_forward softplus logit"
TORCH = f"{COMMON} {OF_TORCH}".split()
EXACT = (-2, -1, -0.5, 0, 0.5, 1, 2, 3)  # powers that are products, roots or quotients


def salt(library):
    return zlib.crc32(f"{library} {SEED}".encode())


def move(values, library):
    """Moves the floats of a contiguous 1-D array, in place; part by part, which needs little
    memory.
    """
    import numpy as np

    if values.dtype not in (np.float32, np.float64):
        return
    kind, factor = (
        (np.uint32, 0x9E3779B1) if values.dtype == np.float32 else (np.uint64, 0x9E3779B97F4A7C15)
    )
    last, digits = kind(8 * values.itemsize - 1), kind((1 << np.finfo(values.dtype).nmant) - 1)
    for first in range(0, values.size, 1 << 14):
        part = values[first : first + (1 << 14)]
        with np.errstate(all="ignore"):
            bits = part.view(kind)
            stays = (
                (bits & digits == 0)
                | np.isnan(part)
                | ((np.abs(part) < WHOLE) & (part == np.floor(part)))
            )
            up = (bits + kind(salt(library))) * kind(factor) >> last == 1
            towards = np.where(up, np.inf, -np.inf).astype(part.dtype)
            part[:] = np.where(stays, part, np.nextafter(part, towards))


def change_math():
    def moved(function):
        @wraps(function)
        def other(*args):
            x = function(*args)
            if (
                not math.isfinite(x)
                or math.frexp(abs(x))[0] == 0.5
                or (abs(x) < WHOLE and x.is_integer())
            ):
                return x
            return math.nextafter(
                x, math.inf if zlib.crc32(x.hex().encode(), salt("math")) & 1 else -math.inf
            )

        return other

    for name in MATH:
        setattr(math, name, moved(getattr(math, name)))


def change_numpy(numpy):
    class Other:
        """A call of the ufunc is moved; the rest is the ufunc's own."""

        def __init__(self, ufunc):
            self.ufunc = ufunc

        def __call__(self, *args, **kwargs):
            found = self.ufunc(*args, **kwargs)
            values = numpy.array(found, order="C")
            move(values.reshape(-1), "numpy")
            if not isinstance(found, numpy.ndarray):
                return values[()]
            numpy.copyto(found, values, where=kwargs.get("where", True))
            return found

        def __getattr__(self, name):
            return getattr(self.ufunc, name)

    for name in NUMPY:
        setattr(numpy, name, Other(getattr(numpy, name)))


def change_torch(torch):
    library = torch.library.Library("aten", "IMPL")
    change_torch.keep = library  # its kernels end with it

    def moved(tensor):
        values = tensor.detach().contiguous()
        move(values.view(-1).numpy(), "torch")
        if values.data_ptr() != tensor.data_ptr():
            tensor.copy_(values)

    def change(name):
        kernel = torch.library.get_kernel(name, "CPU")

        def other(keys, *args, **kwargs):
            found = kernel.call_boxed(keys, *args, **kwargs)
            if not (
                name.startswith("aten::pow")
                and isinstance(args[1], int | float)
                and args[1] in EXACT
            ):
                moved(found[0] if isinstance(found, tuple) else found)
            return found

        library.impl(name, other, "CPU", with_keyset=True)

    for name in torch._C._dispatch_get_all_op_names():
        function, _, form = name.partition(".")
        named = function.removesuffix("_").removeprefix("aten::") in TORCH
        inner = "out" in form  # the others call them
        if named and not inner and torch._C._dispatch_has_kernel_for_dispatch_key(name, "CPU"):
            with warnings.catch_warnings(action="ignore"):  # that a kernel is replaced
                change(name)


def change_stamp(compiling):
    # compiled code of its own
    compiling._STAMP += f"{SEED} {zlib.crc32(Path(__file__).read_bytes())}"


class Finder:
    """Changes a module when it has been imported."""

    CHANGES = {
        "numpy": change_numpy,
        "torch": change_torch,
        "clod_adapter._kernels.compiling": change_stamp,
    }

    @classmethod
    def find_spec(cls, name, path=None, target=None):
        change = cls.CHANGES.get(name)
        spec = importlib.machinery.PathFinder.find_spec(name, path) if change else None
        if spec:
            execute = spec.loader.exec_module

            def both(module):
                execute(module)
                change(module)

            spec.loader.exec_module = both
        return spec


if SEED is not None:
    change_math()
    sys.meta_path.insert(0, Finder)
