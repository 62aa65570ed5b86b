"""The command line: commands, nothing else."""

import os

# With several threads BLAS adds up in another order, and the last digits depend on the number of cores. NumPy reads
# these when it is imported; who sets them has the choice.
for _variable in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
