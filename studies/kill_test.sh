#!/bin/sh
# Is there anything that synergies could give on a task? Plain SAC, ETL, and ETL with two oracles;
# one of these also with its muscles shuffled, and without any, two controls.
#
#     sh studies/kill_test.sh [TASK [FRAMES]]      default: myoLegWalk 400000
#     JOBS=2 SEEDS=[0,1,2] sh studies/kill_test.sh      two runs at a time, three seeds
#
# A thread a run, seeds 0 and 1, one after the other by default; rows go to docs/results/kill_test.
# Kill it at any time and start it again, here or on another machine: finished runs stay (the table
# alone is enough), others go on from their checkpoints, and an oracle is made when what it needs is
# there.
# It takes 1.5 to 2 hours a run on a free core with AVX2.
set -e
cd "$(dirname "$0")/.."
task=${1:-myoLegWalk} frames=${2:-400000}
python=${PYTHON:-.venv/bin/python}
out=docs/results/kill_test
export OMP_NUM_THREADS=1

# An update per 8 frames, targets of three steps at a horizon of 50; the averaged actor spans as many
# frames as by default. ETL explores for 20,000 frames with 5,000 updates.
settings="learn.replay_ratio=0.125 learn.learning_starts=5000 learn.buffer_size=400000
  learn.sac.gamma=0.98 learn.n_steps=3 learn.sac.ema_decay=0.998
  explore.frames=20000 explore.replay_ratio=0.25
  evaluation.every=25000 evaluation.episodes=5 checkpoint.every=50000 log_every=5000"

queue() { # method, more settings
  $python recipes/sweep.py "tasks=[$task]" "methods=[$1]" "seeds=${SEEDS:-[0,1]}" frames="$frames" \
    out=$out jobs="${JOBS:-1}" settings="$(echo $settings $2)"
}

control() { # of etl_body: its name, and what makes its synergies
  oracle=runs/oracles/body_$1-$task method=etl_body_$1
  shift
  [ -d "$oracle" ] || $python studies/body_synergies.py "$task" "$oracle" "$@"
  queue "$method"
}

queue sac
queue etl learn.prefill=true
queue etl_no_reuse
queue etl_body
control shuffled --shuffle 0
control still --still
learned=$out/$task-sac-seed0
for model in gmvae pca; do
  oracle=runs/oracles/learned_$model-$task
  [ -d "$oracle" ] ||
    $python studies/learned_synergies.py "$learned" "$oracle" --model $model
  queue etl_learned_$model
done
