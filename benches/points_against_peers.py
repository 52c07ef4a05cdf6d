#!/usr/bin/env python3
"""Voxel means, outlier removal and normals of one scan: Adit beside Open3D, MeshLib and SciPy, one after the other.

    PEERS_VENV=DIR benches/points_against_peers.py SCAN.las [--bench target/release/deps/points-HASH] [--neighbours 16]

PEERS_VENV names a Python environment with numpy, laspy and, as far as they are there, open3d and meshlib; the script starts
itself again in it. Without it nothing is compared. The bench executable is built by `cargo bench --bench points --no-run`,
which prints its name. Each line tells wall seconds and CPU seconds (all threads) of the step alone, without reading.
"""
import argparse
import os
import subprocess
import sys
import time


def timed(name, step, tell=lambda result: ""):
    wall, cpu = time.perf_counter(), time.process_time()
    result = step()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{name:<28} {wall:8.3f} s wall {cpu:8.2f} s CPU   {tell(result)}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan")
    parser.add_argument("--bench", help="executable of `cargo bench --bench points --no-run`")
    parser.add_argument("--neighbours", type=int, default=16)
    parser.add_argument("--cell", type=float, default=0.05)
    given = parser.parse_args()
    venv = os.environ.get("PEERS_VENV")
    if not venv:
        sys.exit("PEERS_VENV is not set: there is nothing to compare with")
    python = os.path.join(venv, "bin", "python")
    if os.path.realpath(sys.prefix) != os.path.realpath(venv):
        os.execv(python, [python, *sys.argv])
    import laspy
    import numpy as np

    command = [given.bench] if given.bench else ["cargo", "bench", "--quiet", "--bench", "points", "--"]
    options = ["--cell", str(given.cell), "--neighbours", str(given.neighbours), "--repeat", "1"]
    print("adit", flush=True)
    subprocess.run([*command, given.scan, *options], check=True)

    las = laspy.read(given.scan)
    points = np.ascontiguousarray(las.xyz) - np.floor(las.header.mins)
    try:
        import open3d as o3d
    except ImportError:
        print("open3d is not there")
    else:
        print("open3d", flush=True)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        timed("voxel_down_sample", lambda: cloud.voxel_down_sample(given.cell), lambda c: f"kept {len(c.points)}")
        outliers = lambda: cloud.remove_statistical_outlier(given.neighbours, 2.0)
        timed("remove_statistical_outlier", outliers, lambda r: f"kept {len(r[1])}")
        search = o3d.geometry.KDTreeSearchParamKNN(given.neighbours)
        timed("estimate_normals", lambda: cloud.estimate_normals(search))
    try:
        import meshlib.mrmeshnumpy as mn
        import meshlib.mrmeshpy as mm
    except ImportError:
        print("meshlib is not there")
    else:
        print("meshlib", flush=True)
        cloud = mn.pointCloudFromPoints(points)
        normals = lambda: mm.makeUnorientedNormals(cloud, mm.findAvgPointsRadius(cloud, given.neighbours))
        timed("makeUnorientedNormals", normals)


if __name__ == "__main__":
    main()
