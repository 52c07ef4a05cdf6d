#!/bin/sh
# Makes the pictures of docs/methods again: what the classes, the mesh methods and the quality layers make of a synthetic
# drift with duct, cables, rails and a vehicle. Needs Python 3 with numpy, laspy[lazrs], matplotlib and Pillow.
set -eu
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
adit() { cargo run --release --locked --quiet -- "$@"; }

adit synth --quiet --out "$work/drift.laz" --length 18 --alignment straight --azimuth 90 --points 400000 \
    --furniture duct,cables,rails,vehicle
for method in section poisson; do
    adit run --quiet --input "$work/drift.laz" --out "$work/$method" --set "mesh.method=\"$method\"" --set map.cell_m=0.02 \
        --set 'map.layers=["classes","coverage","noise","density","offset"]' --set axis.direction_azimuth_deg=90 ||
        [ $? -eq 5 ] # a broken quality limit is told in the report
done

python3 - "$work" docs/pictures <<'PYTHON'
import sys
from pathlib import Path

import laspy
import matplotlib
import numpy as np
from PIL import Image

matplotlib.use("Agg")
import matplotlib.pyplot as plt

work, target = map(Path, sys.argv[1:])
CLASSES = [("wall", "#8a8a8a"), ("floor", "#b08d57"), ("furniture", "#d62728"), ("outside", "#1f77b4"), ("noise", "#000000")]


def save(figure, name):
    figure.savefig(work / name, dpi=110)
    picture = Image.open(work / name).convert("RGB").quantize(64, dither=Image.Dither.NONE)
    picture.save(target / name, optimize=True)
    print(target / name, picture.size)


def read_mesh(path):
    """Vertices in scan coordinates, faces, and which faces are observed."""
    kinds = {"double": "<f8", "float": "<f4", "uchar": "u1", "int": "<i4"}
    with open(path, "rb") as file:
        fields, counts, scale = [], {}, None
        while (line := file.readline().decode().split()) != ["end_header"]:
            if line[0] == "element":
                counts[line[1]] = int(line[2])
                current = line[1]
            elif line[0] == "comment" and line[1] == "adit_frame":
                scale = [float(x) for x in line[2:5]]
            elif line[0] == "property" and current == "vertex":
                fields.append((line[2], kinds[line[1]]))
        vertices = np.frombuffer(file.read(counts["vertex"] * np.dtype(fields).itemsize), fields)
        face = np.dtype([("n", "u1"), ("v", "<i4", 3), ("observed", "u1")])
        faces = np.frombuffer(file.read(counts["face"] * face.itemsize), face)
    xyz = np.stack([vertices[c] for c in "xyz"], 1)
    return xyz if (np.abs(xyz[0]) > 1e5).any() else xyz + scale, faces["v"], faces["observed"] > 0


def cut(vertices, faces, x):
    """Segments in which a mesh meets the plane of a chainage, as (face, [[y, z], [y, z]])."""
    side = vertices[:, 0] > x
    crossing = np.nonzero(side[faces].any(1) & ~side[faces].all(1))[0]
    for f in crossing:
        ends = []
        for a, b in ((0, 1), (1, 2), (2, 0)):
            p, q = vertices[faces[f, a]], vertices[faces[f, b]]
            if side[faces[f, a]] != side[faces[f, b]]:
                ends.append((p + (q - p) * (x - p[0]) / (q[0] - p[0]))[1:])
        yield f, np.array(ends)


scan = laspy.read(work / "section" / "points.laz")
points = np.stack([scan.x, scan.y, scan.z], 1)
classes, chainage, girth = (np.asarray(scan[n]) for n in ("surface_class", "chainage", "girth"))
axis = np.genfromtxt(work / "section" / "axis.csv", delimiter=",", skip_header=1)
at = 12.6  # through the vehicle
x = np.interp(at, axis[:, 0], axis[:, 1])

figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.6), width_ratios=[1, 2.1], layout="constrained")
near = np.abs(points[:, 0] - x) < 0.12
for value, (name, color) in enumerate(CLASSES):
    mine = near & (classes == value)
    left.scatter(-(points[mine, 1] - axis[0, 2]), points[mine, 2] - axis[0, 3], s=2.5, c=color, label=name, linewidths=0)
    mine = (classes == value) & (np.abs(chainage) < 1e6)  # no-data is far below
    some = np.nonzero(mine)[0][:: 1 if value in (2, 4) else 3]
    right.scatter(chainage[some], girth[some], s=0.6 if value < 2 else 1.2, c=color, linewidths=0)
left.set(aspect="equal", title=f"Section at chainage {at} m, 24 cm thick", xlabel="right of the axis, m", ylabel="above the axis, m")
right.set(title="All points, unrolled", xlabel="chainage, m", ylabel="girth from the crown, m")
figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=5, markerscale=5, frameon=False)
save(figure, "segment_classes.png")

figure, panels = plt.subplots(1, 2, figsize=(12, 5.4), layout="constrained", sharey=True)
for panel, method in zip(panels, ("section", "poisson")):
    vertices, faces, observed = read_mesh(work / method / "mesh.ply")
    mine = near & (classes < 3)
    panel.scatter(-(points[mine, 1] - axis[0, 2]), points[mine, 2] - axis[0, 3], s=2, c="#bbbbbb", linewidths=0)
    for f, segment in cut(vertices, faces, x):
        panel.plot(-(segment[:, 0] - axis[0, 2]), segment[:, 1] - axis[0, 3], lw=1.6, c="#1a4f9c" if observed[f] else "#e07b00")
    panel.set(aspect="equal", title=f'mesh.method = "{method}"', xlabel="right of the axis, m")
panels[0].set_ylabel("above the axis, m")
for color, text in (("#1a4f9c", "observed surface"), ("#e07b00", "filled, marked"), ("#bbbbbb", "points")):
    panels[0].plot([], [], c=color, lw=2, label=text)
figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
save(figure, "mesh_methods.png")

layers = [("classes", "classes: what was seen first"), ("coverage", "coverage: observed, filled, nothing"),
          ("noise", "noise of the surface"), ("density", "point density")]
figure, panels = plt.subplots(2, 2, figsize=(12, 8.2), layout="constrained")
for panel, (layer, title) in zip(panels.flat, layers):
    picture = Image.open(work / "section" / "map" / f"{layer}.png").convert("RGBA")
    paper = Image.new("RGBA", picture.size, "white")
    paper.alpha_composite(picture)
    panel.imshow(paper.resize((picture.width, picture.height), Image.NEAREST))
    panel.set(title=title, xticks=[], yticks=[])
save(figure, "quality_layers.png")
PYTHON
