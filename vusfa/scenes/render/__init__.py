"""Rooms that are drawn, furnished and rendered here: from a kind and a seed, or from a plan, to a scene file.

One module for each step: :mod:`kinds <vusfa.scenes.render.kinds>`, :mod:`layout
<vusfa.scenes.render.layout>` and :mod:`flat <vusfa.scenes.render.flat>` draw a :class:`Plan`; :mod:`grid
<vusfa.scenes.render.grid>` makes its poses and graph; :mod:`textures <vusfa.scenes.render.textures>`,
:mod:`meshes <vusfa.scenes.render.meshes>` and :mod:`geometry <vusfa.scenes.render.geometry>` its shapes;
:mod:`renderer <vusfa.scenes.render.renderer>` its pictures; and :func:`render_room` its file. Drawing plans
needs no more than this package; rendering needs ``pip install 'vusfa[render]'`` and the furniture of Debian's
``sweethome3d-furniture``.

>>> from vusfa.scenes.render import layout, poses
>>> poses(layout("bathroom", seed=1)).num_states
176
"""

from vusfa.scenes.render.catalogue import Catalogue
from vusfa.scenes.render.flat import flat
from vusfa.scenes.render.grid import Poses, poses
from vusfa.scenes.render.layout import layout
from vusfa.scenes.render.plan import Plan
from vusfa.scenes.render.plan_file import from_yaml, load_plan, save_plan, to_yaml
from vusfa.scenes.render.room import Rendered, render_room

__all__ = [
    "Catalogue",
    "Plan",
    "Poses",
    "Rendered",
    "flat",
    "from_yaml",
    "layout",
    "load_plan",
    "poses",
    "render_room",
    "save_plan",
    "to_yaml",
]
