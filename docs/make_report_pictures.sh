#!/bin/sh
# Makes the pictures of the report page in the documentation again: the bundled sample, headless Chromium, phone and
# desktop. Needs chromium and Python 3 with Pillow (for a small palette only).
set -eu
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
adit="${ADIT:-target/release/adit}"

"$adit" run --input sample_scans/bent_drift.laz --out "$work/run" --quiet --set map.cell_m=0.01 >/dev/null ||
    [ $? -eq 5 ] # a broken quality limit is part of the picture

shoot() { # name width height
    chromium --headless --no-sandbox --disable-gpu --hide-scrollbars --user-data-dir="$work/browser" \
        --host-resolver-rules="MAP * ~NOTFOUND" --screenshot="$work/$1.png" --window-size="$2,$3" \
        "file://$work/run/report.html" 2>/dev/null
    python3 - "$work/$1.png" "docs/pictures/$1.png" <<'PYTHON'
import sys
from PIL import Image
picture = Image.open(sys.argv[1]).convert("RGB")
picture.quantize(96, dither=Image.Dither.NONE).save(sys.argv[2], optimize=True)
print(sys.argv[2], picture.size)
PYTHON
}
shoot report_desktop 1100 1900
shoot report_phone 500 1900
