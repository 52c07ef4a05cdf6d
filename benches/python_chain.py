#!/usr/bin/env python3
"""The whole job, side by side: `adit run` and a chain of Python packages that does the same steps.

    benches/python_chain.py SCAN.laz [--adit target/release/adit] [--cell 0.005] [--repeat 1]

The chain: laspy (with lazrs) reads; Open3D thins to 2 cm voxels, removes statistical outliers, estimates and orients
normals and makes a screened Poisson surface (depth 9), trimmed where it is far from points; NumPy and SciPy trace an axis
from slices, unroll vertices and points around it, and draw colour, intensity, labels, offset and coverage; Pillow and
tifffile write them; laspy writes the points with chainage, girth and offset. It makes fewer products than Adit (no cut
mesh, no distortion, no exact way back), so it is the lighter job.

Both run one after the other on the same machine, with the same number of cores. Prints seconds (wall and CPU), peak memory
and the ratios. Needs numpy, scipy, laspy[lazrs], open3d, pillow, tifffile.
"""
import argparse
import os
import subprocess
import sys
import tempfile
import time


def chain(scan, out, cell):
    """The Python chain; returns seconds per step."""
    import laspy
    import numpy as np
    import open3d as o3d
    import tifffile
    from PIL import Image
    from scipy.interpolate import CubicSpline
    from scipy.spatial import cKDTree

    clock, steps = [time.perf_counter()], {}

    def done(step):
        now = time.perf_counter()
        steps[step] = now - clock[0]
        clock[0] = now

    las = laspy.read(scan)
    origin = np.floor(las.header.mins)
    points = np.stack([las.x, las.y, las.z], -1) - origin
    names = set(las.point_format.dimension_names)
    color = np.stack([las.red, las.green, las.blue], -1) / 65535 if "red" in names else np.full((len(points), 3), 0.5)
    label = next((np.asarray(las[n]) for n in ("label", "fracture") if n in names), np.zeros(len(points), np.int32))
    done("read")

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(0.02)
    cloud, _ = cloud.remove_statistical_outlier(16, 2.5)
    done("clean")

    # Axis: centres of slices across the main direction, twice, the second time across the first axis.
    thin = np.asarray(cloud.points)
    middle = thin.mean(0)
    direction = np.linalg.svd((thin - middle)[:: max(1, len(thin) // 20000)], full_matrices=False)[2][0]
    direction *= np.sign(direction[np.argmax(np.abs(direction[:2]))])
    along = (thin - middle) @ direction
    edges = np.arange(along.min(), along.max() + 1, 1.0)
    slices = np.digitize(along, edges)
    centres = [0.5 * (thin[slices == k].min(0) + thin[slices == k].max(0)) for k in np.unique(slices)
               if (slices == k).sum() > 50]
    centres = np.array(centres)
    smooth = centres.copy()
    for _ in range(3):
        smooth[1:-1] = 0.25 * smooth[:-2] + 0.5 * smooth[1:-1] + 0.25 * smooth[2:]
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))]
    spline = CubicSpline(length, smooth)
    stations = np.arange(0, length[-1], 0.05)
    path, tangent = spline(stations), spline(stations, 1)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    left = np.cross([0, 0, 1.0], tangent)
    left /= np.linalg.norm(left, axis=1)[:, None]
    up = np.cross(tangent, left)
    tree = cKDTree(path)
    done("axis")

    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(16))
    thin, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    inward = path[tree.query(thin, workers=-1)[1]] - thin
    normals[(normals * inward).sum(1) < 0] *= -1
    cloud.normals = o3d.utility.Vector3dVector(normals)
    done("normals")

    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=9)
    far, _ = cKDTree(thin).query(np.asarray(mesh.vertices), workers=-1)
    mesh.remove_vertices_by_mask(far > 0.05)
    done("mesh")

    def section(p):
        nearest = tree.query(p, workers=-1)[1]
        d = p - path[nearest]
        s = stations[nearest] + (d * tangent[nearest]).sum(1)
        right, above = -(d * left[nearest]).sum(1), (d * up[nearest]).sum(1)
        return s, np.arctan2(right, above), np.hypot(right, above)

    s, angle, radius = section(np.asarray(mesh.vertices))
    # Girth: arc length around the mean section.
    bins = 360
    which = ((angle + np.pi) / (2 * np.pi) * bins).astype(int).clip(0, bins - 1)
    mean = np.bincount(which, radius, bins) / np.maximum(np.bincount(which, minlength=bins), 1)
    theta = np.linspace(-np.pi, np.pi, bins + 1)
    ring = np.r_[mean, mean[0]]
    outline = np.stack([ring * np.sin(theta), ring * np.cos(theta)], -1)
    arc = np.r_[0, np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))]
    arc -= np.interp(0, theta, arc)
    chart = np.stack([s, np.interp(angle, theta, arc)], -1)
    done("unwrap")

    ps, pa, pr = section(points)
    girth = np.interp(pa, theta, arc)
    offset = pr - np.interp(pa, theta, ring)
    keep = np.abs(offset) < 0.3
    width, height = int((ps.max() - ps.min()) / cell) + 1, int((arc[-1] - arc[0]) / cell) + 1
    x = ((ps[keep] - ps.min()) / cell).astype(int).clip(0, width - 1)
    y = ((arc[-1] - girth[keep]) / cell).astype(int).clip(0, height - 1)
    pixel = y * width + x
    count = np.bincount(pixel, minlength=width * height)
    seen = count > 0
    filled_from = None

    def layer(values):
        nonlocal filled_from
        grid = np.bincount(pixel, values, width * height) / np.maximum(count, 1)
        if filled_from is None:
            # Gaps up to 5 cm take the nearest seen pixel.
            places = np.stack(np.nonzero(seen.reshape(height, width)), -1)
            holes = np.stack(np.nonzero(~seen.reshape(height, width)), -1)
            distance, nearest = cKDTree(places).query(holes, distance_upper_bound=0.05 / cell, workers=-1)
            ok = np.isfinite(distance)
            filled_from = (holes[ok], places[nearest[ok]])
        grid = grid.reshape(height, width)
        to, source = filled_from
        grid[to[:, 0], to[:, 1]] = grid[source[:, 0], source[:, 1]]
        return grid

    layers = {f"color{i}": layer(color[keep, i]) for i in range(3)}
    layers["intensity"] = layer(np.asarray(las.intensity)[keep].astype(float))
    layers["offset"] = layer(offset[keep])
    labels = np.zeros(width * height, np.int32)
    labels[pixel] = label[keep]
    done("map")

    rgb = (np.stack([layers[f"color{i}"] for i in range(3)], -1).clip(0, 1) * 255).astype(np.uint8)
    Image.fromarray(rgb).save(f"{out}/color.png")
    for name in ("intensity", "offset"):
        tifffile.imwrite(f"{out}/{name}.tif", layers[name].astype(np.float32), compression="zlib")
    tifffile.imwrite(f"{out}/labels.tif", labels.reshape(height, width), compression="zlib")
    Image.fromarray((seen.reshape(height, width) * 255).astype(np.uint8)).save(f"{out}/coverage.png")
    o3d.io.write_triangle_mesh(f"{out}/mesh.ply", mesh)
    np.savez(f"{out}/chart.npz", chart=chart)
    for name in ("chainage", "girth", "offset"):
        if name not in names:
            las.add_extra_dim(laspy.ExtraBytesParams(name, np.float64))
    las["chainage"], las["girth"], las["offset"] = ps, girth, offset
    las.write(f"{out}/points.laz")
    done("write")
    return steps


def measured(command):
    """Wall seconds, CPU seconds, peak MiB and output of a child process."""
    start = time.perf_counter()
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    output = child.stdout.read()
    _, status, usage = os.wait4(child.pid, 0)
    code = os.waitstatus_to_exitcode(status)
    if code not in (0, 5):
        sys.exit(f"{' '.join(command)}: exit {code}\n{output}")
    return time.perf_counter() - start, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, output


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan")
    parser.add_argument("--adit", default="target/release/adit")
    parser.add_argument("--cell", type=float, default=0.005, help="pixel size, metres")
    parser.add_argument("--repeat", type=int, default=1, help="the best of so many runs counts")
    parser.add_argument("--chain-into", help=argparse.SUPPRESS)
    a = parser.parse_args()
    if a.chain_into:
        for step, seconds in chain(a.scan, a.chain_into, a.cell).items():
            print(f"    {step:8} {seconds:7.2f} s")
        return
    best = {}
    for _ in range(a.repeat):
        for name in ("adit", "python"):
            with tempfile.TemporaryDirectory() as out:
                if name == "adit":
                    command = [a.adit, "run", "--input", a.scan, "--out", f"{out}/run", "--set", f"map.cell_m={a.cell}",
                               "--quiet"]
                else:
                    command = [sys.executable, __file__, a.scan, "--cell", str(a.cell), "--chain-into", out]
                found = measured(command)
                if name not in best or found[0] < best[name][0]:
                    best[name] = found
    for name, (wall, cpu, memory, output) in best.items():
        print(f"{name:8} {wall:8.1f} s wall {cpu:8.1f} s CPU {memory:8.0f} MiB")
        if name == "python":
            print(output, end="")
    ratios = [p / q for p, q in zip(best["python"][:3], best["adit"][:3])]
    print("python / adit: wall x{:.1f}, CPU x{:.1f}, memory x{:.1f}".format(*ratios))


if __name__ == "__main__":
    main()
