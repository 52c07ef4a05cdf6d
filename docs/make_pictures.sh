#!/bin/sh
# Makes the pictures of the documentation again, with the program, from the bundled sample. Needs Python 3 with Pillow for
# scaling only.
set -eu
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

cargo run --release --locked --quiet -- run --input sample_scans/bent_drift.laz --out "$work/run" --set map.cell_m=0.01 ||
    [ $? -eq 5 ] # a broken quality limit is told in the report and makes no worse pictures

# The sample's points carry the labels of its fractures, so its label map has their traces.
cargo run --release --locked --quiet -- trace "$work/run" --labels "$work/run/map/labels.png" --out "$work/traces.gpkg" --quiet
cargo run --release --locked --quiet -- planes "$work/run" --traces "$work/traces.gpkg" --out "$work/run/map" --quiet

python3 - "$work/run/map" docs/pictures <<'PYTHON'
import sys
from pathlib import Path
from PIL import Image

source, target = map(Path, sys.argv[1:])
target.mkdir(parents=True, exist_ok=True)
for layer, name, width, colors in [
    ("map", "sample_overview", 1200, 128),
    ("color", "sample_map", 1000, 96),
    ("distortion", "sample_distortion", 700, 64),
    ("offset", "sample_offset", 700, 64),
    ("labels", "sample_labels", 700, 16),
    ("stereonet", "sample_stereonet", 700, 32),
]:
    picture = Image.open(source / f"{layer}.png").convert("RGBA")
    paper = Image.new("RGBA", picture.size, "white")
    paper.alpha_composite(picture)
    height = round(paper.height * width / paper.width)
    method = Image.NEAREST if layer == "labels" else Image.LANCZOS
    # A small palette keeps the pictures small.
    small = paper.convert("RGB").resize((width, height), method).quantize(colors, dither=Image.Dither.NONE)
    small.save(target / f"{name}.png", optimize=True)
    print(target / f"{name}.png", small.size)
PYTHON
