#!/usr/bin/env python3
"""The table of docs/methods/relax.md: what `straightness` trades, measured on tunnels of Adit's own generator.

    benches/straightness_table.py [--adit target/release/adit] [--points 250000]

For a straight tunnel and bends of 120 m and 20 m radius: `adit synth` makes a scan, `adit run` its mesh and axis, and
`adit unwrap --method relax` flattens the mesh for each straightness. Each cell: mean stretch / chainage error rms in metres /
bearing error rms in degrees. The last row is `arap`, which knows no ruler.
"""
import argparse
import json
import os
import subprocess
import tempfile

TUNNELS = {"straight": ["--alignment", "straight"]}
TUNNELS |= {f"{radius} m bend": ["--alignment", "bend", "--radius", str(radius)] for radius in (120, 20)}
STRAIGHTNESS = (0, 0.1, 0.25, 0.5, 0.75, 1)


def run(*command):
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if done.returncode not in (0, 5):
        raise SystemExit(f"{' '.join(map(str, command))}: exit {done.returncode}\n{done.stderr}")
    return done.stdout


def cell(adit, folder, method, *settings):
    report = json.loads(run(adit, "unwrap", f"{folder}/mesh.ply", "--axis", f"{folder}/axis.csv", "--method", method,
                            "--out", f"{folder}/flat.ply", "--json", "--quiet", *settings))
    read = report["readability"]
    figures = f"{report['stretch']['mean']:.4f} / {read['chainage_rms_m']:.2f} / {read['bearing_rms_deg']:.1f}"
    return figures, report["faces"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--adit", default="target/release/adit")
    parser.add_argument("--points", type=int, default=250_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = {f"{s}": [] for s in STRAIGHTNESS} | {"`arap`": []}
        faces = []
        for name, course in TUNNELS.items():
            scan, out = os.path.join(folder, "scan.laz"), os.path.join(folder, name.replace(" ", "_"))
            run(options.adit, "synth", "--section", "horseshoe:8.2x6.7", "--length", 30, "--furniture", "none", "--points",
                options.points, *course, "--out", scan)
            run(options.adit, "run", "--input", scan, "--out", out, "--quiet", "--set", 'unwrap="section"', "--set", "map.cell_m=0.1")
            for s in STRAIGHTNESS:
                figures, count = cell(options.adit, out, "relax", "--set", f"straightness={float(s)}")
                rows[f"{s}"].append(figures)
            rows["`arap`"].append(cell(options.adit, out, "arap")[0])
            faces.append(count)
        print(f"Faces: {', '.join(map(str, faces))}\n\n| `straightness` | {' | '.join(TUNNELS)} |\n|---|---|---|---|")
        for name, figures in rows.items():
            print(f"| {name} | {' | '.join(figures)} |")


if __name__ == "__main__":
    main()
