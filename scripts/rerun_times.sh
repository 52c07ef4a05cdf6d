#!/bin/bash
# How much of a run a rerun costs, in CPU seconds: with nothing changed (at most 2 %), and with another pixel size (only
# the map and what follows). Takes a scan, by default the bundled one.
set -eu
cd "$(dirname "$0")/.."
scan="${1:-sample_scans/bent_drift.laz}"
adit="${ADIT:-target/release/adit}"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# CPU seconds of one run, children included.
cpu() {
    { time -p "$adit" run --input "$scan" --out "$work/run" --quiet "$@" >/dev/null || [ $? -eq 5 ]; } 2>"$work/time"
    awk '$1 == "user" || $1 == "sys" { sum += $2 } END { printf "%.2f\n", sum }' "$work/time"
}
first=$(cpu)
again=$(cpu)
echo "with another pixel size:"
"$adit" explain "$work/run" --set map.cell_m=0.03
map=$(cpu --set map.cell_m=0.03)
awk -v f="$first" -v a="$again" -v m="$map" 'BEGIN {
    printf "first %.2f s, again %.2f s (%.2f %%), other pixel size %.2f s (%.0f %%)\n", f, a, 100 * a / f, m, 100 * m / f
    exit !(a <= 0.02 * f && m < f)
}'
