#!/usr/bin/env python3
"""A large map, side by side: the map stage of `adit run` and the same rasters made with NumPy, SciPy and rasterio.

    benches/big_map.py SCAN.laz [--adit target/release/adit] [--cell 0.002] [--keep FOLDER]

Adit first runs the whole pipeline (not counted), then draws again at the given pixel size: colour, intensity, labels and the
way back (`xyz`, `surface_point`), as Cloud Optimized GeoTIFFs and PNGs. Python takes `points.laz` and `chart.ply` of that run
and draws, block by block, colour, intensity and labels of the nearest point (KD-tree) and `xyz` by linear interpolation of
the chart's vertices, as tiled Deflate GeoTIFFs with overviews: no blending, no surface points, no pictures, so it is the
lighter job. Prints seconds (wall and CPU) and peak memory of both.

Needs numpy, scipy, laspy[lazrs], rasterio.
"""
import argparse
import os
import subprocess
import sys
import tempfile
import time

LAYERS = '["color","intensity","labels","xyz","surface_point"]'
BLOCK = 2048


def python_map(run, cell, out):
    import laspy
    import numpy as np
    import rasterio
    from rasterio.enums import Resampling
    from rasterio.transform import from_origin
    from rasterio.windows import Window
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import Delaunay, cKDTree

    las = laspy.read(f"{run}/points.laz")
    u, v = np.asarray(las["chainage"]), np.asarray(las["girth"])
    good = np.isfinite(u) & np.isfinite(v) & (np.abs(np.asarray(las["offset"])) < 0.1)
    u, v = u[good], v[good]
    color = np.stack([np.asarray(las[c])[good] >> 8 for c in ("red", "green", "blue")]).astype("u1")
    intensity, label = np.asarray(las.intensity)[good], np.asarray(las["label"])[good].astype("u1")
    with open(f"{run}/chart.ply", "rb") as f:
        count = 0
        while (line := f.readline()).strip() != b"end_header":
            if line.startswith(b"element vertex"):
                count = int(line.split()[2])
        vertices = np.frombuffer(f.read(count * 41), dtype=[("d", "<f8", 5), ("o", "u1")])["d"]
    origin = np.floor(vertices[:, :3].min(0) / 100) * 100
    u0, u1, v0, v1 = vertices[:, 3].min(), vertices[:, 3].max(), vertices[:, 4].min(), vertices[:, 4].max()
    width, height = int(np.ceil((u1 - u0) / cell)), int(np.ceil((v1 - v0) / cell))
    profile = dict(driver="GTiff", width=width, height=height, tiled=True, blockxsize=256, blockysize=256, compress="deflate",
                   zlevel=3, bigtiff="if_safer", transform=from_origin(u0, v1, cell, cell))
    kinds = {"color": (3, "uint8", 2), "intensity": (1, "uint16", 2), "labels": (1, "uint8", 2), "xyz": (3, "float32", 1)}
    files = {k: rasterio.open(f"{out}/{k}.tif", "w", count=n, dtype=t, predictor=p, **profile) for k, (n, t, p) in kinds.items()}
    tree = cKDTree(np.stack([u, v], 1))
    for row in range(0, height, BLOCK):
        for column in range(0, width, BLOCK):
            h, w = min(BLOCK, height - row), min(BLOCK, width - column)
            x = u0 + (column + np.arange(w) + 0.5) * cell
            y = v1 - (row + np.arange(h) + 0.5) * cell
            place = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
            window = Window(column, row, w, h)
            _, near = tree.query(place, distance_upper_bound=0.06, workers=os.cpu_count())
            missing = near == len(u)
            near[missing] = 0
            for k, values in (("color", color), ("intensity", intensity[None]), ("labels", label[None])):
                drawn = values[:, near]
                drawn[:, missing] = 0
                files[k].write(drawn.reshape(-1, h, w), window=window)
            inside = ((vertices[:, 3] > x[0] - 0.3) & (vertices[:, 3] < x[-1] + 0.3)
                      & (vertices[:, 4] < y[0] + 0.3) & (vertices[:, 4] > y[-1] - 0.3))
            if inside.sum() > 3:
                part = vertices[inside]
                xyz = LinearNDInterpolator(Delaunay(part[:, 3:]), part[:, :3] - origin)(place)
                files["xyz"].write(xyz.T.reshape(3, h, w).astype("f4"), window=window)
    for f in files.values():
        f.close()
    for k in kinds:
        with rasterio.open(f"{out}/{k}.tif", "r+") as f:
            f.build_overviews([2, 4, 8, 16, 32], Resampling.nearest if k in ("labels", "xyz") else Resampling.average)
    print(f"{width} x {height} pixels, {width * height / 1e6:.0f} million")


def measure(name, command):
    start = time.perf_counter()
    process = subprocess.Popen(command)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"{name} failed: {' '.join(command)}")
    wall = time.perf_counter() - start
    print(f"{name:8} {wall:8.1f} s wall {usage.ru_utime + usage.ru_stime:8.1f} s CPU {usage.ru_maxrss / 1024:8.0f} MiB", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scan")
    parser.add_argument("--adit", default="target/release/adit")
    parser.add_argument("--cell", type=float, default=0.002)
    parser.add_argument("--keep", help="work here and keep everything")
    parser.add_argument("--python-part", nargs=2, metavar=("RUN", "OUT"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.python_part:
        python_map(arguments.python_part[0], arguments.cell, arguments.python_part[1])
        sys.exit()
    folder = arguments.keep or tempfile.mkdtemp(prefix="big_map_")
    run, out = f"{folder}/run", f"{folder}/python"
    os.makedirs(out, exist_ok=True)
    adit = [arguments.adit, "run", "--quiet", "--input", arguments.scan, "--out", run]
    subprocess.run(adit, check=True)
    measure("adit", adit + ["--set", f"map.cell_m={arguments.cell}", "--set", f"map.layers={LAYERS}"])
    measure("python", [sys.executable, __file__, arguments.scan, "--cell", str(arguments.cell), "--python-part", run, out])
