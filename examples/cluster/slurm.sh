#!/usr/bin/env bash
# One command of vusfa on several machines of a Slurm cluster, with a Ray cluster that lives as long as the job:
#
#   sbatch examples/cluster/slurm.sh vusfa table1 launcher=ray launcher_options=[address=auto]
#   sbatch examples/cluster/slurm.sh vusfa train cluster=ray cluster.address=auto cluster.workers=4 folder=runs/first
#
# A job that is cut off goes on when the same command is given again. Cells alone need no Ray: `vusfa table1 launcher=slurm
# launcher_options=[partition=NAME,timeout_min=600]` makes a job of each.
#SBATCH --job-name=vusfa
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --time=10:00:00
#SBATCH --requeue
set -euo pipefail

if [ "$#" = 0 ]; then
    set -- vusfa table1 launcher=ray 'launcher_options=[address=auto]'
fi
head="$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)"
port=$((6400 + SLURM_JOB_ID % 1000)) # of this job alone, should two share a machine
# every machine starts Ray; the first one runs the command as soon as all are there, and then all stop
srun --kill-on-bad-exit=1 ray symmetric-run --address "$head:$port" --min-nodes "$SLURM_JOB_NUM_NODES" \
    --num-cpus "$SLURM_CPUS_PER_TASK" -- "$@"
