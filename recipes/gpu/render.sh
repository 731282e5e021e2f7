#!/usr/bin/env bash
# Renders the sets of base_mix.toml and small.toml; resumes. First argument: number of processes; second: seed of the
# scenes, 1701 if not given; third: folder, runs/synth if not given.
set -euo pipefail
cd "$(dirname "$0")/../.."
make() { python3 -m stereoweave synth make "$@" --jobs "$jobs"; }
jobs=${1:-$(nproc)}
scenes_seed=${2:-1701}
folder=${3:-runs/synth}
seed=$((scenes_seed + 2))

make rooms --pairs 600 --seed "$seed" -o "$folder/rooms"
make street --pairs 150 --seed "$seed" -o "$folder/street"
make figures --pairs 200 --seed "$seed" -o "$folder/figures"
for scene in antenna bridge crane pylon refinery ship wind_turbine propeller; do
    make "$scene" --pairs 16 --seed "$scenes_seed" -o "$folder/scenes/$scene"
done
