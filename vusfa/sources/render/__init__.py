"""Rooms that are drawn, furnished and rendered here: from a kind and a seed, or from a plan, to a scene file.

One module for each step: :mod:`kinds <vusfa.sources.render.kinds>`, :mod:`layout
<vusfa.sources.render.layout>` and :mod:`flat <vusfa.sources.render.flat>` draw a :class:`Plan`; :mod:`grid
<vusfa.sources.render.grid>` makes its poses and graph; :mod:`textures <vusfa.sources.render.textures>`,
:mod:`meshes <vusfa.sources.render.meshes>` and :mod:`geometry <vusfa.sources.render.geometry>` its shapes;
:mod:`renderer <vusfa.sources.render.renderer>` its pictures, which :mod:`variation
<vusfa.sources.render.variation>` changes; and :func:`render_room` its file. Drawing plans
needs no more than this package; rendering needs ``pip install 'vusfa[render]'`` and the furniture of Debian's
``sweethome3d-furniture``.

>>> from vusfa.sources.render import layout, poses
>>> poses(layout("bathroom", seed=1)).num_states
176
"""

from vusfa.sources.render.catalogue import Catalogue
from vusfa.sources.render.flat import flat
from vusfa.sources.render.grid import Poses, poses
from vusfa.sources.render.layout import layout
from vusfa.sources.render.plan import Plan
from vusfa.sources.render.plan_file import from_yaml, load_plan, save_plan, to_yaml
from vusfa.sources.render.room import Rendered, render_room
from vusfa.sources.render.variation import VARIATIONS, Variation, load_variation

__all__ = [
    "VARIATIONS",
    "Catalogue",
    "Plan",
    "Poses",
    "Rendered",
    "Variation",
    "flat",
    "from_yaml",
    "layout",
    "load_plan",
    "load_variation",
    "poses",
    "render_room",
    "save_plan",
    "to_yaml",
]
