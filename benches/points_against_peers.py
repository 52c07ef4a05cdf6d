#!/usr/bin/env python3
"""Voxel means, outlier removal and normals of one scan: Adit beside Open3D, MeshLib and PCL, one after the other.

    PEERS_VENV=DIR benches/points_against_peers.py SCAN.las [--bench target/release/deps/points-HASH] [--truth TRUTH.npz]

PEERS_VENV names a Python environment with numpy, scipy, laspy and, as far as they are there, open3d and meshlib; the script
starts itself again in it. Without it nothing is compared. PCL takes part when its program `pcl_voxel_grid` is installed. The
bench executable is built by `cargo bench --bench points --no-run`, which prints its name. Each line tells wall seconds and
CPU seconds (all threads) of the step alone, without reading; PCL's program tells no CPU seconds. With TRUTH.npz, vertices V
and faces F of the true surface, each line of normals tells their median angle, in degrees, to the true normal of the
nearest face, over 20,000 points within 5 cm of the surface.
"""
import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
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
    parser.add_argument("--truth", help="vertices V and faces F of the true surface, for the error of normals")
    given = parser.parse_args()
    venv = os.environ.get("PEERS_VENV")
    if not venv:
        sys.exit("PEERS_VENV is not set: there is nothing to compare with")
    python = os.path.join(venv, "bin", "python")
    if os.path.realpath(sys.prefix) != os.path.realpath(venv):
        os.execv(python, [python, *sys.argv])
    import laspy
    import numpy as np

    las = laspy.read(given.scan)
    points = np.ascontiguousarray(las.xyz) - np.floor(las.header.mins)
    error = lambda normals: ""
    if given.truth:
        from scipy.spatial import cKDTree

        truth = np.load(given.truth)
        a, b, c = (truth["V"][truth["F"][:, k]] for k in range(3))
        true_normals = np.cross(b - a, c - a)
        true_normals /= np.linalg.norm(true_normals, axis=1)[:, None]
        sample = np.random.default_rng(1).choice(len(points), min(20_000, len(points)), replace=False)
        distance, nearest = cKDTree((a + b + c) / 3).query(np.ascontiguousarray(las.xyz)[sample])
        near = distance < 0.05

        def error(normals):
            cosine = np.abs((normals[sample] * true_normals[nearest]).sum(axis=1))[near]
            return f"median error {np.degrees(np.median(np.arccos(np.clip(cosine, 0, 1)))):.2f} degrees"

    with tempfile.TemporaryDirectory() as folder:
        command = [given.bench] if given.bench else ["cargo", "bench", "--quiet", "--bench", "points", "--"]
        out = os.path.join(folder, "normals")
        options = ["--cell", str(given.cell), "--neighbours", str(given.neighbours), "--repeat", "1", "--normals", out]
        print("adit", flush=True)
        subprocess.run([*command, given.scan, *options], check=True)
        for kind in ["fixed", "adaptive"] if given.truth else []:
            print(f"normals, {kind:<19} {error(np.fromfile(f'{out}.{kind}').reshape(-1, 3))}", flush=True)
        if shutil.which("pcl_voxel_grid"):
            print("pcl", flush=True)
            pcd = os.path.join(folder, "cloud.pcd")
            with open(pcd, "wb") as file:
                n = len(points)
                fields = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
                file.write(f"VERSION 0.7\n{fields}WIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA binary\n".encode())
                file.write(points.astype("<f4").tobytes())
            leaf = ",".join([str(given.cell)] * 3)
            told = subprocess.run(
                ["pcl_voxel_grid", pcd, os.path.join(folder, "thin.pcd"), "-leaf", leaf],
                check=True,
                capture_output=True,
                text=True,
            )
            # Reading, the step, writing: each "[done, MS ms : POINTS points]".
            steps = re.findall(r"\[done, ([\d.e+]+) ms *: (\d+)", re.sub(r"\x1b\[[\d;]*m", "", told.stdout + told.stderr))
            print(f"{'voxel_grid':<28} {float(steps[1][0]) / 1000:8.3f} s wall {'':12}   kept {steps[1][1]}", flush=True)

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
        timed("estimate_normals", lambda: cloud.estimate_normals(search), lambda _: error(np.asarray(cloud.normals)))
    try:
        import meshlib.mrmeshnumpy as mn
        import meshlib.mrmeshpy as mm
    except ImportError:
        print("meshlib is not there")
    else:
        print("meshlib", flush=True)
        cloud = mn.pointCloudFromPoints(points)
        normals = lambda: mm.makeUnorientedNormals(cloud, mm.findAvgPointsRadius(cloud, given.neighbours))
        timed("makeUnorientedNormals", normals, lambda n: error(mn.toNumpyArray(n)))


if __name__ == "__main__":
    main()
