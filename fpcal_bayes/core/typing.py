"""Arrays as signatures name them; lengths in um, angles in rad unless a name says otherwise."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
