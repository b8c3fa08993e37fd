"""One code for NumPy's arrays, to lift, and torch's tensors, to train and to export.

Both know the names of the array API standard, ``axis`` and ``keepdims``, and these two functions are what they
do not share.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Tensor = Any  #: Array of NumPy or tensor of torch, float32 where nothing else is said


def namespace(x: Tensor) -> Any:
    """Return the module whose functions take an array: NumPy or torch."""
    if isinstance(x, np.ndarray):
        return np
    import torch

    return torch


def like(x: Tensor, values: Tensor) -> Tensor:
    """Return numbers, or a mask as ones and zeros, as an array of the kind and type of another."""
    if isinstance(x, np.ndarray):
        return np.asarray(values, x.dtype)
    return values.to(x.dtype) if isinstance(values, type(x)) else x.new_tensor(values)
