"""The extension module: what the Python package calls. Arrays are C-contiguous."""

from typing import Any

import numpy as np
import numpy.typing as npt

_Float32 = npt.NDArray[np.float32]
_Bool = npt.NDArray[np.bool_]
_Int64 = npt.NDArray[np.int64]

__version__: str
