#!/usr/bin/env python3
"""The section and the poisson surface of oriented points beside Open3D's (poisson at the same depth) and MeshLib's, measured
against the true surface.

    PEERS_VENV=DIR benches/surface_against_peers.py ORIENTED.npz TRUTH.npz --bench EXECUTABLE [--depth 9] [--meshlib]

ORIENTED.npz holds P and N (points and unit normals into the void), TRUTH.npz the vertices V and faces F of the true surface.
PEERS_VENV names a Python environment with numpy and open3d (and meshlib); the script starts itself again in it. The bench
executable is built by `cargo bench --bench surface --no-run`, which prints its name. Each line tells wall seconds and
CPU seconds (all threads) of the step alone and, over vertices in use: root mean square distance from the truth, of all and
of those nearer than 10 cm, the share that is farther away, and the share of the truth's vertices within 2 cm of the mesh;
then the boundary loops and how far the surface goes at most from the nearest point (middles of faces and vertices), faces that
Adit marks as filled told apart.
"""
import argparse
import os
import subprocess
import sys
import tempfile
import time


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("oriented")
    parser.add_argument("truth")
    parser.add_argument("--bench", required=True)
    parser.add_argument("--depth", type=int, default=9)
    parser.add_argument("--cell", type=float, help="edge of Adit's cells in metres; that of the depth when not given")
    parser.add_argument("--meshlib", action="store_true")
    given = parser.parse_args()
    venv = os.environ.get("PEERS_VENV")
    if not venv:
        sys.exit("PEERS_VENV is not set: there is nothing to compare with")
    python = os.path.join(venv, "bin", "python")
    if os.path.realpath(sys.prefix) != os.path.realpath(venv):
        os.execv(python, [python, *sys.argv])
    import numpy as np
    import open3d as o3d
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    data, truth = np.load(given.oriented), np.load(given.truth)
    points, normals = np.ascontiguousarray(data["P"]), np.ascontiguousarray(data["N"])
    true_vertices, true_faces = truth["V"], truth["F"]

    def distances(vertices, faces, queries):
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32)))
        parts = [queries[a : a + 200_000].astype(np.float32) for a in range(0, len(queries), 200_000)]
        return np.concatenate([scene.compute_distance(o3d.core.Tensor(p)).numpy() for p in parts])

    def boundary_loops(faces):
        edges = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        edges, count = np.unique(edges, axis=0, return_counts=True)
        ends, index = np.unique(edges[count == 1], return_inverse=True)
        index = index.reshape(-1, 2)
        graph = coo_matrix((np.ones(len(index)), (index[:, 0], index[:, 1])), (len(ends), len(ends)))
        return connected_components(graph, directed=False)[0]

    tree = cKDTree(points)

    def farthest_cm(vertices, faces):
        places = np.vstack([vertices[np.unique(faces)], vertices[faces].mean(axis=1)])
        return 100 * tree.query(places, workers=-1)[0].max()

    def tell(name, vertices, faces, observed=None):
        used = vertices[np.unique(faces)]
        d = distances(true_vertices, true_faces, used)
        sample = true_vertices[np.random.default_rng(3).choice(len(true_vertices), 200_000, replace=False)]
        covered = (distances(vertices, faces, sample) < 0.02).mean()
        seen = "" if observed is None else f", observed at most {farthest_cm(vertices, faces[observed]):.2f}"
        rms = lambda e: 1000 * np.sqrt((e**2).mean())
        print(
            f"{name:<18} {len(faces):8d} faces  rms {rms(d):7.2f} mm, within 10 cm {rms(d[d < 0.1]):5.2f} mm, "
            f"farther {100 * (d >= 0.1).mean():.2f} %, truth covered {100 * covered:.1f} %, {boundary_loops(faces)} boundary "
            f"loops, at most {farthest_cm(vertices, faces):.1f} cm from a point{seen}",
            flush=True,
        )

    # Open3D's cube is 1.1 times the longest side of the box.
    cell = given.cell or 1.1 * (points.max(0) - points.min(0)).max() / 2**given.depth
    with tempfile.TemporaryDirectory() as folder:
        oriented, mesh = os.path.join(folder, "oriented.f64"), os.path.join(folder, "mesh")
        np.hstack([points, normals]).astype("<f8").tofile(oriented)
        print(f"adit, poisson in cells of {cell:.4f} m", flush=True)
        subprocess.run([given.bench, oriented, str(cell), "--mesh", mesh], check=True)
        for method in ["section", "poisson"]:
            with open(f"{mesh}.{method}", "rb") as file:
                nv, nf = np.fromfile(file, "<i8", 2)
                vertices = np.fromfile(file, "<f8", 3 * nv).reshape(-1, 3)
                faces = np.fromfile(file, "<i4", 3 * nf).reshape(-1, 3)
                observed = np.fromfile(file, "u1", nf) > 0
            tell(f"adit {method}", vertices, faces, observed)

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    wall, cpu = time.perf_counter(), time.process_time()
    theirs, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=given.depth)
    print(f"open3d {time.perf_counter() - wall:.3f} s wall {time.process_time() - cpu:.2f} s CPU")
    tell(f"open3d poisson {given.depth}", np.asarray(theirs.vertices), np.asarray(theirs.triangles))
    if given.meshlib:
        import meshlib.mrmeshnumpy as mn
        import meshlib.mrmeshpy as mm

        cloud = mn.pointCloudFromPoints(points, normals)
        wall, cpu = time.perf_counter(), time.process_time()
        theirs = mm.triangulatePointCloud(cloud)
        print(f"meshlib {time.perf_counter() - wall:.3f} s wall {time.process_time() - cpu:.2f} s CPU")
        tell("meshlib", mn.getNumpyVerts(theirs), mn.getNumpyFaces(theirs.topology))


if __name__ == "__main__":
    main()
