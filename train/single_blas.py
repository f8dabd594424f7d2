"""One thread for NumPy's matrix products: imported by programs that play policies, before anything imports NumPy.

Layers of a policy are too small to be shared, and threads of OpenBLAS spin while they wait: 512 episodes of 20 s took
18 to 20 s of processor time on two cores, now 7, for the same bits.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
