#!/bin/sh
# SAC and ETL (without prefill, log 116) on all 13 tasks, three seeds, a million frames, where there
# are a GPU and many cores.
#
#     sh studies/on_gpu.sh [FRAMES]      default: 1000000
#     TASKS=[myoHandKeyTurn] METHODS=[sac,dynsyn] SEEDS=[0,1,2,3] \
#       MORE="learner=plain learn.reward_scale=0.1 learn.sac.alpha_init=0.1" \
#       sh studies/on_gpu.sh 150000
#
# All seeds of a task and method learn in one pass, each with its simulators in a process of its own;
# with JOBS=2 two such passes share the GPU. Rows go to OUT, docs/results/on_gpu by default. It may be
# killed at any time and started again, here or on another machine.
set -e
cd "$(dirname "$0")/.."
tasks=myoHandPose,myoHandKeyTurn,myoHandPenTwirl,myoBaodingFull,myoDieReorientFull,myoRelocateFull
tasks=$tasks,myoLegWalk,myoLegStairTerrainWalk
tasks=$tasks,humanoid-stand,humanoid-walk,humanoid-run,dog-walk,dog-run
export OMP_NUM_THREADS=1

# Collecting ahead is not how anything else here was trained (log 111); all seeds collect at once.
settings="device=cuda compile=true
  collector=process collector.num_workers=1 collector.ahead=false
  evaluation.every=25000 evaluation.episodes=5 checkpoint.every=100000 log_every=5000"

exec ${PYTHON:-.venv/bin/python} recipes/sweep.py "tasks=${TASKS:-[$tasks]}" \
  "methods=${METHODS:-[sac,etl_no_reuse]}" "seeds=${SEEDS:-[0,1,2]}" frames="${1:-1000000}" \
  out="${OUT:-docs/results/on_gpu}" jobs="${JOBS:-1}" seeds_at_once=true \
  settings="$(echo $settings $MORE)"
