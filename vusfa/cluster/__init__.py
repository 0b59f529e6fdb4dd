"""Many machines: an experiment's cells and what runs them, environments on Ray (docs/cluster.md).

Importing this package registers the launchers ``local``, ``slurm`` and ``ray`` with
:mod:`vusfa.cluster.cells`; Ray and Hydra's plugins are imported when they run.

>>> import vusfa.cluster
>>> from vusfa.cluster.cells import LAUNCHERS
>>> sorted(LAUNCHERS)
['local', 'ray', 'serial', 'slurm']
"""

from vusfa.cluster.cells import register_launcher
from vusfa.cluster.launchers import launch_locally, launch_on_ray, launch_on_slurm

__all__ = ["launch_locally", "launch_on_ray", "launch_on_slurm"]

register_launcher("local", launch_locally)
register_launcher("slurm", launch_on_slurm)
register_launcher("ray", launch_on_ray)
