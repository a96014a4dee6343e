"""What a program says before numpy and torch are imported: threads of theirs that wait must not spin.

torch's (OpenMP) are told to sleep. numpy's (OpenBLAS) cannot be: a product of small matrices wakes one for every core,
and on a busy machine waits for them longer than it computes (a coordinate grid of 224x224: 8 ms, alone 0.3). All
matrices of a pair are small, so numpy computes in the thread that asks.
"""

from __future__ import annotations

import os


def keep_idle_threads_from_spinning() -> None:
    """Called by programs, never by an import; what the environment says already stands."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
