#!/bin/sh
# All checks: format, lints, documentation, tests. Needs only the Rust toolchain (Python 3 for the peers in benches/ is
# not used here). Ends with a line that says whether everything passed.
set -eu
cd "$(dirname "$0")/.."

step() {
    echo "== $*"
    "$@"
}

step cargo fmt --check
step cargo clippy --locked --all-targets --quiet -- -D warnings
RUSTDOCFLAGS="-D warnings" step cargo doc --locked --no-deps --quiet
step cargo test --locked --quiet
echo "== everything passed"
