"""`python -m pipeline`."""

import os

# The matrices are small: several threads of BLAS cost more in waiting than they give, on a busy machine tenfold.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from pipeline.run import main  # noqa: E402 - NumPy reads these variables when it is first imported

raise SystemExit(main())
