"""Builds locagen_edge._kernel from the C sources (cffi, API mode, limited API).

What Python sees is what stands between the two marks of locagen.h, so the header stays the only
place where the API is written down.
"""

import re
from pathlib import Path

from cffi import FFI

HERE = Path(__file__).parent.resolve()
ROOT = HERE.parent

# -ffast-math is out: gcc 12 links crtfastmath.o with it, which flushes denormals to zero in the whole
# process, numpy's too. Reassociation is out as well: it undoes the shared sums of the FFT's butterflies.
CFLAGS = [
    "-std=gnu11",
    "-O3",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-Wall",
    "-Wextra",
]
SOURCES = ["gcc_phat.c", "steering.c", "spectrum.c", "fft.c", "frame_quad.c", "frame_avx2.c", "resample.c"]
HEADERS = sorted(path.name for path in HERE.glob("*.h"))

header = (HERE / "locagen.h").read_text(encoding="utf-8")
match = re.search(r"/\* \[python\].*?\*/(.*?)/\* \[/python\] \*/", header, re.DOTALL)
if match is None:
    raise SystemExit("csrc/locagen.h: the [python] marks are missing")

ffi = FFI()
ffi.cdef(match.group(1))
ffi.set_source(
    "locagen_edge._kernel",
    '#include "locagen.h"',
    sources=[str((HERE / name).relative_to(ROOT)) for name in SOURCES],
    include_dirs=[str(HERE.relative_to(ROOT))],
    depends=[str((HERE / name).relative_to(ROOT)) for name in HEADERS],
    extra_compile_args=CFLAGS,
    libraries=["m"],
)
