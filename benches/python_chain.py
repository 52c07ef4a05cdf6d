#!/usr/bin/env python3
"""The whole job, side by side: `adit run` and a chain of Python packages that does the same steps.

    benches/python_chain.py SCAN.laz [--adit target/release/adit] [--cell 0.005] [--repeat 1]

The chain: laspy (with lazrs) reads; Open3D thins to 2 cm voxels, removes statistical outliers, estimates and orients
normals and makes a screened Poisson surface (depth 9), trimmed where it is far from points; NumPy and SciPy trace an axis
from slices, unroll the vertices around it and cut the mesh at the invert; libigl flattens it (ARAP, 10 iterations from that
guide, as Adit's default method starts from its own); Open3D finds the place of every point on the mesh; NumPy draws colour,
intensity, labels, offset, coverage and distortion; Pillow writes pictures, rasterio GeoTIFFs with overviews on all cores;
laspy writes the points with chainage, girth and offset. It makes fewer products than Adit (no classes, no overview sheet, no
report, no certificate of the way back), so it is still the lighter job.

Both run one after the other on the same machine, with the same number of cores. Prints seconds (wall and CPU), peak memory
and the ratios. Needs numpy, scipy, laspy[lazrs], open3d, libigl, pillow, rasterio.
"""
import argparse
import os
import subprocess
import sys
import tempfile
import time


def chain(scan, out, cell):
    """The Python chain; returns seconds per step."""
    import igl
    import laspy
    import numpy as np
    import open3d as o3d
    import rasterio
    from PIL import Image
    from rasterio.enums import Resampling
    from rasterio.transform import from_origin
    from scipy.interpolate import CubicSpline
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
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
    mesh.merge_close_vertices(1e-6)
    mesh.remove_degenerate_triangles()
    done("mesh")

    def section(p):
        nearest = tree.query(p, workers=-1)[1]
        d = p - path[nearest]
        s = stations[nearest] + (d * tangent[nearest]).sum(1)
        right, above = -(d * left[nearest]).sum(1), (d * up[nearest]).sum(1)
        return s, np.arctan2(right, above), np.hypot(right, above)

    # Cut at the invert, and keep the greatest piece.
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    s, angle, radius = section(vertices)
    corner = angle[faces]
    faces = faces[corner.max(1) - corner.min(1) < np.pi]
    edges = np.r_[faces[:, :2], faces[:, 1:]]
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), (len(vertices),) * 2)
    piece = connected_components(graph, False)[1]
    faces = faces[piece[faces[:, 0]] == np.bincount(piece[faces[:, 0]]).argmax()]
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces, s, angle, radius = vertices[used], faces.reshape(-1, 3), s[used], angle[used], radius[used]
    done("cut")

    # Guide: chainage, and arc length around the mean section.
    bins = 360
    which = ((angle + np.pi) / (2 * np.pi) * bins).astype(int).clip(0, bins - 1)
    mean = np.bincount(which, radius, bins) / np.maximum(np.bincount(which, minlength=bins), 1)
    theta = np.linspace(-np.pi, np.pi, bins + 1)
    ring = np.r_[mean, mean[0]]
    outline = np.stack([ring * np.sin(theta), ring * np.cos(theta)], -1)
    arc = np.r_[0, np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))]
    arc -= np.interp(0, theta, arc)
    guide = np.stack([s, np.interp(angle, theta, arc)], -1)
    arap = igl.ARAPData()
    arap.max_iter = 10
    pin = np.array([len(vertices) // 2], np.int32)
    igl.arap_precomputation(vertices, faces.astype(np.int64), 2, pin, arap)
    chart = np.asarray(igl.arap_solve(guide[pin], arap, guide))[:, :2]
    # Singular values of the map from each face.
    x, y = vertices[faces], chart[faces]
    e1, e2 = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
    length = np.linalg.norm(e1, axis=1)
    unit = e1 / length[:, None]
    along, high = (e2 * unit).sum(1), np.linalg.norm(np.cross(unit, e2), axis=1)
    f1, f2 = (y[:, 1] - y[:, 0]) / length[:, None], y[:, 2] - y[:, 0]
    f2 = (f2 - f1 * along[:, None]) / high[:, None]
    sum_, difference = np.hypot(f1[:, 0] + f2[:, 1], f1[:, 1] - f2[:, 0]), np.hypot(f1[:, 0] - f2[:, 1], f1[:, 1] + f2[:, 0])
    stretch = np.stack([(sum_ + difference) / 2, (sum_ - difference) / 2], -1)
    done("unwrap")

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32)))
    near = scene.compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))
    face = near["primitive_ids"].numpy()
    weight = near["primitive_uvs"].numpy()
    weight = np.c_[1 - weight.sum(1), weight]
    place = (chart[faces[face]] * weight[..., None]).sum(1)
    foot = (vertices[faces[face]] * weight[..., None]).sum(1)
    _, _, radius_here = section(points)
    _, _, radius_foot = section(foot)
    offset = radius_here - radius_foot
    ps, girth = place[:, 0], place[:, 1]
    done("anchor")

    keep = np.abs(offset) < 0.3
    low, high = chart.min(0), chart.max(0)
    width, height = (int(extent / cell) + 1 for extent in high - low)
    x = ((ps[keep] - low[0]) / cell).astype(int).clip(0, width - 1)
    y = ((high[1] - girth[keep]) / cell).astype(int).clip(0, height - 1)
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
    layers["s1"], layers["s2"] = layer(stretch[face[keep], 0]), layer(stretch[face[keep], 1])
    labels = np.zeros(width * height, np.int32)
    labels[pixel] = label[keep]
    done("map")

    def raster(name, bands, averaged=True):
        bands = np.stack(bands)
        profile = dict(driver="GTiff", width=width, height=height, count=len(bands), dtype=bands.dtype, tiled=True,
                       blockxsize=256, blockysize=256, compress="deflate", predictor=2, num_threads="all_cpus",
                       transform=from_origin(low[0], high[1], cell, cell))
        with rasterio.open(f"{out}/{name}.tif", "w", **profile) as f:
            f.write(bands)
        with rasterio.Env(GDAL_NUM_THREADS="ALL_CPUS"), rasterio.open(f"{out}/{name}.tif", "r+") as f:
            f.build_overviews([2, 4, 8, 16], Resampling.average if averaged else Resampling.nearest)

    def picture(name, values):
        dark, light = np.percentile(values[::7, ::7], (1, 99))
        grey = ((values - dark) / max(light - dark, 1e-9)).clip(0, 1) * 255
        Image.fromarray(grey.astype(np.uint8)).save(f"{out}/{name}.png")

    rgb = (np.stack([layers[f"color{i}"] for i in range(3)]).clip(0, 1) * 255).astype(np.uint8)
    coverage = (seen.reshape(height, width) * 255).astype(np.uint8)
    labels = labels.reshape(height, width).astype(np.uint8)
    raster("color", rgb)
    raster("intensity", [layers["intensity"].astype(np.uint16)])
    raster("offset", [layers["offset"].astype(np.float32)])
    raster("distortion", [layers["s1"].astype(np.float32), layers["s2"].astype(np.float32)], averaged=False)
    raster("coverage", [coverage], averaged=False)
    raster("labels", [labels], averaged=False)
    Image.fromarray(np.ascontiguousarray(rgb.transpose(1, 2, 0))).save(f"{out}/color.png")
    picture("intensity", layers["intensity"])
    picture("offset", layers["offset"])
    picture("distortion", np.maximum(layers["s1"], 1 / np.maximum(layers["s2"], 1e-6)))
    Image.fromarray(labels).save(f"{out}/labels.png")
    Image.fromarray(coverage).save(f"{out}/coverage.png")
    o3d.io.write_triangle_mesh(f"{out}/mesh.ply", mesh)
    np.savez(f"{out}/chart.npz", vertices=vertices, faces=faces, chart=chart)
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
