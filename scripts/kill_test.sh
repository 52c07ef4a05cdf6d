#!/bin/sh
# The long form of the kill test: a run is killed (SIGKILL) at 50 moments spread over its whole length, resumed, and its
# products compared byte by byte with those of an undisturbed run. Another number: scripts/kill_test.sh 200
set -eu
cd "$(dirname "$0")/.."
ADIT_KILLS="${1:-50}" cargo test --release --locked --test nights killed_at_any_moment -- --nocapture
