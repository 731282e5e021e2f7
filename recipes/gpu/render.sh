#!/usr/bin/env bash
# Renders the sets that the trainings of this folder read, in runs/; resumes. First argument: number of processes.
set -euo pipefail
cd "$(dirname "$0")/../.."
make() { python3 -m stereoweave synth make "$@" --jobs "$jobs"; }
jobs=${1:-$(nproc)}

make propeller --worlds 5 --frames 625 --seed 4 --size 320x240 --rig 264 0.25 --distance 2.8 3.6 \
    --layout paper -o runs/worlds/propeller
make rooms --pairs 600 --seed 1703 -o runs/synth/rooms
make street --pairs 150 --seed 1703 -o runs/synth/street
make figures --pairs 200 --seed 1703 -o runs/synth/figures
for scene in antenna bridge crane pylon refinery ship wind_turbine propeller; do
    make "$scene" --pairs 16 --seed 1701 -o "runs/synth/scenes/$scene"
done
