#!/usr/bin/env bash
# Renders the sets of base_mix.toml and small.toml in runs/; resumes. First argument: number of processes.
set -euo pipefail
cd "$(dirname "$0")/../.."
make() { python3 -m stereoweave synth make "$@" --jobs "$jobs"; }
jobs=${1:-$(nproc)}

make rooms --pairs 600 --seed 1703 -o runs/synth/rooms
make street --pairs 150 --seed 1703 -o runs/synth/street
make figures --pairs 200 --seed 1703 -o runs/synth/figures
for scene in antenna bridge crane pylon refinery ship wind_turbine propeller; do
    make "$scene" --pairs 16 --seed 1701 -o "runs/synth/scenes/$scene"
done
