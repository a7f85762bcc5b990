#!/usr/bin/env bash
# Commands that plan, calibrate, align and decode, on simulated inputs, and their answers against the truth:
# examples/tour.sh [OUT]
#
# DAIC and REHEARSAL name the programs; without them cargo builds both.
set -euo pipefail
root="$(cd "$(dirname "$0")/.." && pwd)"
out="${1:-tour}"
if [ -z "${DAIC:-}" ] || [ -z "${REHEARSAL:-}" ]; then
    cargo build --release --manifest-path "$root/Cargo.toml" -p daic --bin daic --example rehearsal
    target="$(realpath "${CARGO_TARGET_DIR:-$root/target}")/release"
    DAIC="$target/daic" REHEARSAL="$target/examples/rehearsal"
fi
DAIC="$(realpath "$DAIC")" REHEARSAL="$(realpath "$REHEARSAL")"
optics="$root/examples/golden-macro.toml"

step() {
    printf '\n$ daic %s\n' "$*"
    "$DAIC" --quiet "$@"
}

mkdir -p "$out"
cd "$out"
"$REHEARSAL" .

# what a set-up will be able to measure, before anything is bought
step plan "$optics"

# the camera from a board of dots
step calibrate camera camera/board-*.png --board dots --columns 13 --rows 9 --pitch 6 --fix k2,k3,p1,p2 --out camera-found

# the alignment; the record carries every step into the optics file
align=(--camera camera-found/camera.toml --record align.toml)
step align rail align/aperture-near.png align/aperture-far.png --distances 300,1200 "${align[@]}"
step align laser align/laser-near.png align/laser-far.png --distances 300,1200 "${align[@]}"
step align reflection align/aperture.png align/reflected.png --pinhole-to-aperture 400 --grating-to-aperture 300 "${align[@]}"
step align orders align/orders.png "${align[@]}"
step align distance camera/square.png --board dots --pitch 6,0.001 --grating-to-board 40,0.05 \
    --optics "$optics" --out optics-aligned.toml "${align[@]}"
step align guide "${align[@]}"

# camera, gratings and distances together, from dots of a plate in seven poses
step calibrate rig --optics "$optics" rig/plate.csv --sigma 0.01 --out rig-found
step decode --optics rig-found/optics.toml rig/pairs.csv --out points.csv

# the microscope, from known motions
step calibrate microscope microscope/moves.toml --out microscope.toml --report microscope.html

# a program of the trigger box as a timing diagram
step rig timeline "$root/examples/strobe.json" --out strobe.html

printf '\nthe answers against the truth\n'
"$REHEARSAL" --check .
