"""Values that stand for a vertex index which could not be resolved; below every index a file can hold.

Kept apart from the kernels that write them, so that a reader may compare without importing numba.
"""

ZERO_INDEX = -(1 << 62)
UNREADABLE_INDEX = -(1 << 62) + 1
