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

# Strokes and areas on the colour picture, saved at half its size, and what is recognised.
python3 - "$work" <<'PYTHON'
import json
import sys
from PIL import Image, ImageDraw

work = sys.argv[1]
picture = Image.open(f"{work}/run/map/color.png").convert("RGBA")
classes = json.load(open(f"{work}/run/map/labels.json"))["classes"]
red, blue, green = (tuple(c["color"]) for c in classes[1:4])
width, height = picture.size
x, y = width // 3, height // 3
pen = ImageDraw.Draw(picture)
pen.ellipse((x + 60, y + 60, x + 180, y + 140), fill=green)
pen.line([(x + 20, y + 30), (x + 150, y + 90), (x + 330, y + 60), (x + 560, y + 150)], fill=red, width=3)
pen.line([(x + 250, y + 10), (x + 300, y + 110), (x + 280, y + 190)], fill=blue, width=3)
pen.line([(x + 340, y + 180), (x + 450, y + 40), (x + 580, y + 20)], fill=blue, width=3)
picture.resize((width // 2, height // 2), Image.LANCZOS).save(f"{work}/painted.png")
PYTHON
cargo run --release --locked --quiet -- lift "$work/run" --labels "$work/painted.png" --out "$work/lifted.laz" --recognised "$work/seen.png"
python3 - "$work" docs/pictures <<'PYTHON'
import sys
from PIL import Image

work, target = sys.argv[1:]
painted, seen = (Image.open(f"{work}/{name}.png").convert("RGB") for name in ("painted", "seen"))
x, y = seen.width // 3, seen.height // 3
part = painted.crop((x // 2, y // 2, x // 2 + 300, y // 2 + 100)).resize((600, 200), Image.NEAREST)
both = Image.new("RGB", (600, 410), "white")
both.paste(part, (0, 0))
both.paste(seen.crop((x, y, x + 600, y + 200)), (0, 210))
both.quantize(64, dither=Image.Dither.NONE).save(f"{target}/sample_paint.png", optimize=True)
print(f"{target}/sample_paint.png", both.size)
PYTHON
