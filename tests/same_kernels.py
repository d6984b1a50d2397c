"""Import this before NumPy: processors with AVX2 then compute stored values by the same kernels.

NumPy and OpenBLAS choose among kernels by the processor, and the kernels differ in last bits, which
SLAM amplifies. Here both are kept to what Intel's and AMD's processors have since 2013 and 2015.
A value that the user has set stays. On other processors results may differ from the stored ones.
"""

import os
from pathlib import Path

_CPU = Path("/proc/cpuinfo")
_flags = _CPU.read_text(encoding="utf-8", errors="replace").split() if _CPU.exists() else []
if "avx2" in _flags:
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")
if "avx512f" in _flags:
    os.environ.setdefault("NPY_DISABLE_CPU_FEATURES", "X86_V4 AVX512_ICL AVX512_SPR")
