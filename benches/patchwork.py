"""Time per scan of Patchwork++ on one thread; run alternately with `fpmcl ground SCANS --threads 1`.

    pip install pypatchworkpp
    python benches/patchwork.py SCANS

SCANS is a folder of KITTI scans. Neither time includes reading the files.
"""

import pathlib
import sys
import time

import numpy
import pypatchworkpp

parameters = pypatchworkpp.Parameters()
parameters.verbose = False
patchwork = pypatchworkpp.patchworkpp(parameters)
milliseconds = []
for path in sorted(pathlib.Path(sys.argv[1]).glob("*.bin")):
    scan = numpy.fromfile(path, numpy.float32).reshape(-1, 4)
    for _ in range(3):
        start = time.perf_counter()
        patchwork.estimateGround(scan)
        milliseconds.append(1e3 * (time.perf_counter() - start))
print(f"mean {numpy.mean(milliseconds):.2f} ms, median {numpy.median(milliseconds):.2f} ms")
