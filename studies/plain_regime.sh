#!/bin/sh
# The paper's claim in the paper's own regime: does ETL lead where all methods share textbook SAC?
#
#     sh studies/plain_regime.sh [TASK [FRAMES]]      default: myoHandKeyTurn 50000; Leg Walk: 100000
#
# JOBS, SEEDS, METHODS and PYTHON as in kill_test.sh; rows go to docs/results/plain_regime. It may be
# killed at any time and started again.
set -e
cd "$(dirname "$0")/.."
task=${1:-myoHandKeyTurn} frames=${2:-50000}
export OMP_NUM_THREADS=1

# Textbook SAC, with a reward scale and an initial temperature that suit returns in the thousands.
# ETL's two rows are the default, whose policy moves single muscles too, and the printed one, which
# moves them through synergies alone.
settings="learner=plain learn.reward_scale=0.1 learn.sac.alpha_init=0.1 evaluation.episodes=1"

exec ${PYTHON:-.venv/bin/python} recipes/sweep.py "tasks=[$task]" \
  "methods=[${METHODS:-sac,etl,etl_no_residual,lattice,dep,dynsyn,eme,sar}]" \
  "seeds=${SEEDS:-[0,1]}" frames="$frames" out=docs/results/plain_regime jobs="${JOBS:-1}" \
  settings="$(echo $settings)"
