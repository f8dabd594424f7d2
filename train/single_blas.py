"""Limit NumPy's matrix products to one thread. Programs that run policies import this file before NumPy.

Layers of a policy are too small for several threads, and waiting threads of OpenBLAS use processor time: 512 episodes
of 20 s take 18 to 20 s of processor time with two threads and 7 s with one. Results have the same bits.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
