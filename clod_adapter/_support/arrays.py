"""Arrays of numpy as tensors, and tensors as arrays."""

from typing import Any

import numpy as np
import torch
from torch import Tensor


def tensor_of(values: Any) -> Tensor:
    """A tensor unchanged; an array as a copy, as torch accepts neither foreign byte order nor
    negative strides.
    """
    if isinstance(values, Tensor):
        return values
    array = np.asarray(values)
    return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), order="C"))


def float_tensor(values: Any) -> Tensor:
    """A tensor unchanged; an array in float32, for which the rasterizers are made: numpy's default
    is float64.
    """
    return values if isinstance(values, Tensor) else torch.from_numpy(np.array(values, np.float32))


def float64_array(tensor: Tensor) -> np.ndarray:
    """The values on the host, in float64; shared with a tensor that is there in float64."""
    return tensor.detach().double().cpu().numpy()  # type: ignore[no-any-return]
