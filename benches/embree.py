"""Rays per second of Embree (in Open3D) on the mesh and the rays of `rendering.rs`.

    python benches/embree.py FOLDER [NAME ...]
"""

import pathlib
import sys
import time

import numpy
import open3d

folder = pathlib.Path(sys.argv[1])
mesh = open3d.t.io.read_triangle_mesh(str(folder / "street.ply"))
for threads in (1, 2):
    # The hierarchy is built by the first cast.
    scene = open3d.t.geometry.RaycastingScene(nthreads=threads)
    scene.add_triangles(mesh)
    start = time.process_time(), time.perf_counter()
    scene.cast_rays(open3d.core.Tensor(numpy.ones((1, 6), "float32")))
    cpu, wall = time.process_time() - start[0], time.perf_counter() - start[1]
    print(f"{'build':38}{threads} threads {1e3 * wall:8.1f} ms {1e3 * cpu:8.1f} ms of CPU")
    for file in sorted(folder.glob("*.npy")):
        if sys.argv[2:] and file.stem not in sys.argv[2:]:
            continue
        rays = open3d.core.Tensor(numpy.load(file))
        times = []
        for _ in range(5):
            start = time.process_time(), time.perf_counter()
            scene.cast_rays(rays, nthreads=threads)
            times.append((time.perf_counter() - start[1], time.process_time() - start[0]))
        wall, cpu = min(times)[0], min(cpu for _, cpu in times)
        print(
            f"{file.stem:38}{threads} threads {1e3 * wall:8.1f} ms {1e3 * cpu:8.1f} ms of CPU,"
            f" {rays.shape[0] / wall * 1e-6:6.2f} M rays/s"
        )
