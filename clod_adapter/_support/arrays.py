"""Arrays of numpy as tensors, where the library is called with them."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from clod_adapter.errors import ClodError


def tensor_of(values: Any) -> Tensor:
    """A tensor unchanged; an array as a copy, as torch accepts neither foreign byte order nor negative strides."""
    if isinstance(values, Tensor):
        return values
    array = np.asarray(values)
    return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), order="C"))


def float_tensor(values: Any) -> Tensor:
    """A tensor unchanged; an array in float32, for which the rasterizers are made: numpy's default is float64."""
    if isinstance(values, Tensor):
        return values
    try:
        return torch.from_numpy(np.array(values, np.float32))
    except (TypeError, ValueError) as error:
        raise ClodError(f"{values!r:.80} is no array of numbers") from error
