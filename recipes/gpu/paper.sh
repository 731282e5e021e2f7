#!/usr/bin/env bash
# The paper's trainings on videos of few propellers, side by side on one GPU; resumes (recipes/gpu/README.md).
set -euo pipefail
cd "$(dirname "$0")/../.."
export OMP_NUM_THREADS=1
compare() {
    python3 -m experiments.paper recipes/paper/propeller_networks.toml -o runs/propeller_networks \
        --slow-steps 1500 "$@"
}

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
