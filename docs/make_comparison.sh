#!/bin/sh
# Makes the tables and pictures of docs/methods/comparison.md again, with the program, from tunnels of its own generator.
# Takes a few minutes; needs Python 3 with Pillow for the palette of the pictures only. The figures of
# time and memory are those of the machine it runs on.
set -eu
cd "$(dirname "$0")/.."
work=${1:-$(mktemp -d)}
mkdir -p "$work" docs/pictures
# ADIT names the program if it is built already.
adit() {
    if [ -n "${ADIT:-}" ]; then "$ADIT" "$@"; else cargo run --release --locked --quiet --bin adit -- "$@"; fi
}

# The tunnel of the comparison: 8.2 m x 6.7 m x 41 m, rough, gently bent, nothing in the way.
adit synth --out "$work/tunnel.laz" --section horseshoe:8.2x6.7 --alignment bend --radius 120 --length 41 \
    --roughness 0.12 --furniture none --points 2000000 --stations 6 --noise-mm 2 --outliers 0 --seed 41
adit compare-methods "$work/tunnel.laz" --set mesh.spacing_m=0.15 --out "$work/tunnel"

# Full Newton ABF is for small meshes: the same tunnel, coarser.
adit compare-methods "$work/tunnel.laz" --set mesh.spacing_m=0.25 --methods abf,abf++ --out "$work/coarse"

# The same section on a bend of 20 m: all methods, and the trade-off of relax.
adit synth --out "$work/bend.laz" --section horseshoe:8.2x6.7 --alignment bend --radius 20 --length 30 \
    --roughness 0.12 --furniture none --points 1500000 --stations 6 --noise-mm 2 --outliers 0 --seed 20
adit compare-methods "$work/bend.laz" --set mesh.spacing_m=0.15 --out "$work/bend" \
    --methods section,lscm,relax,abf++,arap,slim,deform-arap,deform-skin
adit compare-methods "$work/bend.laz" --set mesh.spacing_m=0.15 --out "$work/curve" --methods \
    section,arap,relax:straightness=0,relax:straightness=0.1,relax:straightness=0.25,relax:straightness=0.5,relax:straightness=0.75,relax:straightness=0.9,relax:straightness=1

sed "s|$work/||g" "$work/tunnel/comparison.csv" > docs/methods/comparison.csv
cp "$work/bend/comparison.csv" docs/methods/comparison_bend.csv
cp "$work/curve/comparison.csv" docs/methods/comparison_straightness.csv

# A small palette keeps the pictures small.
python3 - "$work/tunnel/comparison.png" docs/pictures/comparison.png "$work/bend/comparison.png" docs/pictures/comparison_bend.png <<'PYTHON'
import sys
from PIL import Image

for source, target in zip(sys.argv[1::2], sys.argv[2::2]):
    small = Image.open(source).convert("RGB").quantize(48, dither=Image.Dither.NONE)
    small.save(target, optimize=True)
PYTHON

# The tables go between their markers in the page.
for name in tunnel coarse bend curve; do
    awk -v name="$name" -v table="$work/$name/comparison.md" '
    $0 == "<!-- table " name " -->" { print; while ((getline row < table) > 0) print row; inside = 1; next }
    $0 == "<!-- end -->" { inside = 0 }
    !inside { print }' docs/methods/comparison.md | sed "s|$work/||g" > "$work/page.md"
    cp "$work/page.md" docs/methods/comparison.md
done

# Mean stretch over bearing error, one point for each straightness, as SVG.
awk -F, '
NR == 1 { for (i = 1; i <= NF; i++) column[$i] = i; next }
{
    x[NR] = $column["bearing_rms_deg"]; y[NR] = 100 * ($column["stretch_mean"] - 1); name[NR] = $1
    if (x[NR] > widest) widest = x[NR]
    if (y[NR] > highest) highest = y[NR]
}
function px(v) { return 70 + 650 * v / (1.1 * widest) }
function py(v) { return 330 - 290 * v / (1.1 * highest) }
END {
    print "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 760 390\" font-family=\"sans-serif\" font-size=\"13\">"
    print "<rect width=\"760\" height=\"390\" fill=\"#fff\"/>"
    print "<path d=\"M70 40V330H720\" fill=\"none\" stroke=\"#444\"/>"
    for (v = 0; v <= 1.05 * highest; v += 2)
        printf "<text x=\"62\" y=\"%.1f\" text-anchor=\"end\">%d %%</text><path d=\"M70 %.1fH720\" stroke=\"#ddd\"/>\n", py(v) + 4, v, py(v)
    for (v = 0; v <= 1.05 * widest; v++)
        printf "<text x=\"%.1f\" y=\"348\" text-anchor=\"middle\">%d</text>\n", px(v), v
    print "<text x=\"395\" y=\"374\" text-anchor=\"middle\">bearing error, root mean square, degrees</text>"
    print "<text x=\"70\" y=\"26\">mean stretch beyond 1</text>"
    line = ""
    for (i = 2; i <= NR; i++) if (name[i] ~ /^relax/) line = line sprintf("%s%.1f %.1f", line == "" ? "M" : "L", px(x[i]), py(y[i]))
    printf "<path d=\"%s\" fill=\"none\" stroke=\"#2668ac\" stroke-width=\"2\"/>\n", line
    for (i = 2; i <= NR; i++) {
        relax = name[i] ~ /^relax/
        label = name[i]; sub(/^relax:straightness=/, "", label)
        printf "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"5\" fill=\"%s\"/>", px(x[i]), py(y[i]), relax ? "#2668ac" : "#b8402a"
        printf "<text x=\"%.1f\" y=\"%.1f\" fill=\"%s\">%s</text>\n", px(x[i]) + 9, py(y[i]) + (relax ? -6 : 18), relax ? "#2668ac" : "#b8402a", label
    }
    print "</svg>"
}' docs/methods/comparison_straightness.csv > docs/pictures/relax_on_a_bend.svg
