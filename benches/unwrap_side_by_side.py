#!/usr/bin/env python3
"""Flattening, side by side: `adit unwrap` and the Python packages that do the same, on the same meshes in one sitting.

    ADIT_PEERS_VENV=/path/to/venv benches/unwrap_side_by_side.py [--adit target/release/adit] [--faces 20000 100000]
                                                                 [--methods lscm arap slim] [--repeat 1]

The mesh is a rough horseshoe-like tunnel on a bend of 120 m, 41 m long, cut open along its invert, written here. Adit runs
as a whole process: its seconds hold starting, reading, finding the axis, the distortion report and writing. A peer's
seconds hold its solve alone, without import and reading, from the section unroll where it needs a start. CPU seconds are
user and system time of all threads. Distortion is measured by this script for all of them in the same way.

The peers need `numpy` and `libigl` in the environment that ADIT_PEERS_VENV names. Without it only Adit is measured, and
the script says so.
"""
import argparse
import json
import math
import os
import struct
import subprocess
import sys
import tempfile
import time

LENGTH, BEND = 41.0, 120.0
PEERS = {"lscm": "igl-lscm", "arap": "igl-arap10", "slim": "igl-slim10"}


def tunnel(faces):
    """Vertices, faces, and the section unroll (chainage, girth) of a mesh with about that many faces."""
    girth = 24.0
    columns = max(8, round(math.sqrt(faces / 2 * girth / LENGTH)))
    rows = round(faces / 2 / columns)
    vertices, unroll, triangles = [], [], []
    for i in range(rows + 1):
        s = LENGTH * i / rows
        for j in range(columns + 1):
            t = (j / columns - 0.5) * 2 * math.pi * 0.9999
            r = 3.8 + 0.35 * math.cos(2 * t) + 0.1 * math.sin(1.7 * s + math.sin(3 * t)) + 0.05 * math.sin(5 * s - 7 * t)
            r += 0.012 * math.sin(41 * s + 97 * t) + 0.006 * math.sin(173 * s - 211 * t)
            right, up, a = r * math.sin(t), r * math.cos(t), s / BEND
            vertices.append(((BEND + right) * math.sin(a), BEND - (BEND + right) * math.cos(a), up + 0.02 * s))
            unroll.append((s, 3.8 * t))
    for i in range(rows):
        for j in range(columns):
            a = i * (columns + 1) + j
            b, c, d = a + columns + 1, a + columns + 2, a + 1
            triangles += [(a, b, c), (a, c, d)]
    return vertices, triangles, unroll


def write_ply(path, vertices, triangles):
    with open(path, "wb") as out:
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
        head += [f"property double {c}" for c in "xyz"]
        head += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
        out.write(("\n".join(head) + "\n").encode())
        for v in vertices:
            out.write(struct.pack("<3d", *v))
        for t in triangles:
            out.write(struct.pack("<B3i", 3, *t))


def adit(program, method, mesh, out):
    """Seconds, CPU seconds, peak MiB and distortion of one run of the whole program."""
    before, start = os.times(), time.perf_counter()
    command = [program, "unwrap", mesh, "--method", method, "--out", out, "--json", "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True)
    seconds, after = time.perf_counter() - start, os.times()
    if done.returncode:
        sys.exit(f"adit unwrap --method {method} ended with {done.returncode}: {done.stderr.strip()}")
    report = json.loads(done.stdout)
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return dict(seconds=seconds, cpu=cpu, mib=report.get("peak_memory_mib"), stretch=report["stretch"]["mean"],
                angle=report["anisotropy"]["mean"], energy=report["symmetric_dirichlet"], flips=report["flipped_faces"])


def peer(name, mesh):
    """Runs in the peers' environment: one solve, one line of JSON."""
    import resource

    import igl
    import numpy as np

    data = np.load(mesh)
    v, f, su = data["vertices"], data["faces"].astype(np.int64), data["unroll"]
    wall, cpu = time.perf_counter(), time.process_time()
    if name == "igl-lscm":
        rim = igl.boundary_loop(f)
        first = rim[np.argmax(((v[rim] - v[rim[0]]) ** 2).sum(1))]
        second = rim[np.argmax(((v[rim] - v[first]) ** 2).sum(1))]
        held = np.array([first, second])
        uv, _ = igl.lscm(v, f, held, np.array([[0.0, 0.0], [float(np.linalg.norm(v[first] - v[second])), 0.0]]))
    elif name == "igl-arap10":
        solver = igl.ARAPData()
        solver.max_iter = 10
        held = np.array([len(v) // 2], np.int32)
        igl.arap_precomputation(v, f, 2, held, solver)
        uv = igl.arap_solve(np.ascontiguousarray(su[held]), solver, np.ascontiguousarray(su))
    else:
        start = np.asfortranarray(su)
        none, nowhere = np.zeros(0, np.int32), np.zeros((0, 2), order="F")
        faces = np.asfortranarray(f.astype(np.int32))
        energy = igl.SYMMETRIC_DIRICHLET
        solver = igl.slim_precompute(np.asfortranarray(v), faces, start, energy, none, nowhere, 0.0)
        uv = np.asarray(igl.slim_solve(solver, 10))[:, :2]
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps(dict(seconds=wall, cpu=cpu, mib=peak, **distortion(v, f, uv))))


def distortion(v, f, uv):
    """Area-weighted means after scaling the map to the area of the surface."""
    import numpy as np

    e, g = v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]
    p, q = uv[f[:, 1]] - uv[f[:, 0]], uv[f[:, 2]] - uv[f[:, 0]]
    twice, turn = np.linalg.norm(np.cross(e, g), axis=1), p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    if turn.sum() < 0:
        turn = -turn
    scale = math.sqrt(twice.sum() / abs(turn.sum()))
    length = np.linalg.norm(e, axis=1)
    first = p * scale / length[:, None]
    along = (e * g).sum(1) / length
    second = (q * scale - first * along[:, None]) / (twice / length)[:, None]
    square, det = (first**2).sum(1) + (second**2).sum(1), np.abs(turn) * scale**2 / twice
    root = np.sqrt(np.maximum(square**2 - 4 * det**2, 0))
    s1 = np.sqrt((square + root) / 2)
    s2 = np.maximum(det / s1, 1e-6)
    mean = lambda x: float((x * twice).sum() / twice.sum())
    return dict(stretch=mean(np.maximum(s1, 1 / s2)), angle=mean(s1 / s2), flips=int((turn <= 0).sum()),
                energy=mean((s1**2 + s2**2 + s1**-2 + s2**-2) / 4))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--adit", default="target/release/adit")
    parser.add_argument("--faces", type=int, nargs="+", default=[20_000, 100_000])
    parser.add_argument("--methods", nargs="+", default=["lscm", "arap", "slim", "abf++", "relax"])
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--peer", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.peer:
        return peer(*options.peer)
    venv = os.environ.get("ADIT_PEERS_VENV")
    if not venv:
        print("ADIT_PEERS_VENV is not set: the peers are skipped, only Adit is measured")
    best = lambda runs: min(runs, key=lambda run: run["cpu"])
    show = lambda x, digits=2: "-" if x is None else f"{x:.{digits}f}"
    print("| faces | who | s | CPU s | MiB | stretch | s1/s2 | sym. Dirichlet | flips | CPU ratio |\n|---|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for count in options.faces:
            vertices, triangles, unroll = tunnel(count)
            mesh, arrays = os.path.join(folder, "mesh.ply"), os.path.join(folder, "mesh.npz")
            write_ply(mesh, vertices, triangles)
            if venv:
                code = "import json,sys,numpy as n;d=json.load(sys.stdin);n.savez(sys.argv[1],**{k:n.array(x) for k,x in d.items()})"
                data = json.dumps(dict(vertices=vertices, faces=triangles, unroll=unroll))
                subprocess.run([f"{venv}/bin/python", "-c", code, arrays], input=data, text=True, check=True)
            for method in options.methods:
                out = os.path.join(folder, "flat.ply")
                own = best([adit(options.adit, method, mesh, out) for _ in range(options.repeat)])
                rows = [(f"adit {method}", own, None)]
                if venv and method in PEERS:
                    command = [f"{venv}/bin/python", __file__, "--peer", PEERS[method], arrays]
                    runs = [subprocess.run(command, capture_output=True, text=True) for _ in range(options.repeat)]
                    failed = next((run for run in runs if run.returncode), None)
                    if failed:
                        last = (failed.stderr.strip().splitlines() or ["no message"])[-1]
                        print(f"{PEERS[method]} failed: {last}", file=sys.stderr)
                    else:
                        other = best([json.loads(run.stdout) for run in runs])
                        rows.append((PEERS[method], other, other["cpu"] / own["cpu"]))
                for who, row, ratio in rows:
                    cells = [len(triangles), who, show(row["seconds"]), show(row["cpu"]), show(row["mib"], 0)]
                    cells += [show(row[k], 5) for k in ("stretch", "angle", "energy")] + [row["flips"], show(ratio, 1)]
                    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


if __name__ == "__main__":
    main()
