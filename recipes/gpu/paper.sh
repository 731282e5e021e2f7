#!/usr/bin/env bash
# Renders videos of few propellers, then trains the paper's networks on them, side by side on one GPU; resumes (recipes/gpu/README.md).
set -euo pipefail
cd "$(dirname "$0")/../.."
export OMP_NUM_THREADS=1
compare() {
    python3 -m experiments.paper recipes/paper/propeller_networks.toml -o runs/propeller_networks \
        --slow-steps 1500 "$@"
}

python3 -m stereoweave synth make propeller --worlds 5 --frames 625 --seed 4 --size 320x240 --rig 264 0.25 \
    --distance 2.8 3.6 --layout paper --jobs "$(nproc)" -o runs/worlds/propeller

started=()
for name in propeller_worlds propeller_metres; do
    python3 -m stereoweave train "recipes/paper/$name.toml" -o "runs/$name" &
    started+=($!)
done
compare --jobs 3 --only "networks, fewer steps" --report runs/fewer_steps &
started+=($!)
compare --jobs 6 --only "projection loss" --only networks --only "depth adjustment" --only iterations \
    --report runs/equal_steps &
started+=($!)
failed=0
for id in "${started[@]}"; do wait "$id" || failed=1; done
exit "$failed"
