"""Names of the array types that all rooms share: NumPy arrays by their numbers. Records: structured arrays of any
fields."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U32 = NDArray[np.uint32]
Records = NDArray[np.void]
