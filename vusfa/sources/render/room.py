"""Rendering of a plan into a scene file: frames, features, graph, credits for the furniture.

Rendering can be stopped and resumed at any time: finished frames and features are kept beside the scene
file, in hidden files that are removed when it is written.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from vusfa.errors import SceneError
from vusfa.scenes.graph import default_actions
from vusfa.scenes.provenance import Provenance, this_tool, today
from vusfa.scenes.validation import raise_faults
from vusfa.sources.backbones import DEFAULT, Backbone, load_backbone
from vusfa.sources.capture import PoseGraph, capture
from vusfa.sources.render import backend as backends
from vusfa.sources.render.catalogue import LICENCES, Catalogue
from vusfa.sources.render.faults import plan_faults
from vusfa.sources.render.frames import Frames
from vusfa.sources.render.geometry import build_scene
from vusfa.sources.render.grid import poses
from vusfa.sources.render.plan import Plan
from vusfa.sources.render.plan_file import to_yaml
from vusfa.sources.render.renderer import Renderer
from vusfa.sources.render.variation import PLAIN, Variation, vary_plan
from vusfa.sources.summary import look_alike_share

__all__ = ["Rendered", "credits", "render_room"]

#: ``progress(what, done, total)``: "frames" or "features"; the first call counts those of an earlier run.
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Rendered:
    """Result of rendering a room.

    Args:
        path: the scene file.
        states: N.
        backend: Mitsuba's variant.
        seconds_per_frame: mean over the frames rendered in this run; None without any.
        look_alikes: share of states that look like another state (:mod:`vusfa.sources.summary`).
    """

    path: Path
    states: int
    backend: str
    seconds_per_frame: float | None
    look_alikes: float

    def __str__(self) -> str:
        rate = f", {self.seconds_per_frame:.2f} s per frame" if self.seconds_per_frame is not None else ""
        return (
            f"{self.path}: {self.states} states, {self.backend}{rate}; {100 * self.look_alikes:.1f} % of them"
            f" look like another state"
        )


def credits(plan: Plan, catalogue: Catalogue) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Licences of the collections of a plan's models, and one line of credit per model."""
    models = [catalogue[name] for name in plan.models]
    collections = sorted({model.collection for model in models})
    licences = tuple(f"{name}: {LICENCES.get(name, 'licence unknown')}" for name in collections)
    return licences, tuple(model.credit for model in models)


def _origin(plan: Plan, catalogue: Catalogue) -> Provenance:
    versions = {name: metadata.version(name) for name in ("mitsuba", "mitsuba-oidn", "trimesh")}
    licences, thanks = credits(plan, catalogue)
    return Provenance(
        made_with=this_tool("scenes render", **versions),
        made_on=today(),
        plan=to_yaml(plan),
        seed=plan.seed,
        licences=licences,
        credits=thanks,
    )


def _attributes(
    plan: Plan, catalogue: Catalogue, backend: backends.Backend, exposure: float, variation: Variation
) -> dict[str, Any]:
    changes = variation.changes()
    return {
        "kind": plan.kind or "room",
        "models": [f"{name} {catalogue[name].title}" for name in plan.models],
        "renderer": backend.variant,
        "exposure": exposure,
        "cell_m": plan.grid.step,
        "agent_radius_m": plan.grid.radius,
        "eye_m": plan.camera.height,
        "hfov_deg": plan.camera.fov,
        "spp": plan.camera.samples,
        "frame": "location=(X right, Z forward); heading 0 = +Z, 90 = +X; RotateRight turns clockwise",
        **(
            {"variation": yaml.safe_dump(changes, default_flow_style=True, width=400).strip()}
            if changes
            else {}
        ),
    }


def _render_frames(
    frames: Frames, plan: Plan, varied: Plan, renderer_of: Callable[[Plan], Renderer], report: Progress
) -> float | None:
    """Render the missing frames; returns the mean seconds per frame, without loading, or None without any."""
    spent, renderer = 0.0, None
    for room, step, ready in (
        (plan, frames.measure, frames.measured),
        (varied, frames.render, frames.complete),
    ):
        if ready:
            continue
        if renderer is None or room != plan:
            renderer = renderer_of(room)
        began = time.monotonic()
        step(renderer.frame, lambda: report("frames", frames.done, frames.total))
        spent += time.monotonic() - began
    return spent / frames.rendered if frames.rendered else None


def render_room(
    plan: Plan,
    out: str | os.PathLike[str],
    progress: Progress | None = None,
    *,
    catalogue: Catalogue | None = None,
    backbone: str | Backbone = DEFAULT,
    backend: backends.Backend | None = None,
    threads: int | None = None,
    say: Callable[[str], None] | None = None,
    variation: Variation = PLAIN,
) -> Rendered:
    """Render every pose of a plan and write the scene, atomically; resumes a run that was stopped.

    The same plan gives the same graph and poses, and with the same variant and versions the same pictures.

    Args:
        plan: the room.
        out: scene file to write.
        progress: called for frames, then for features.
        catalogue: furniture with its files; that of this machine by default.
        backbone: network of the features, or its name for :func:`vusfa.sources.backbones.load_backbone`.
        backend: Mitsuba's variant; the fastest one that works by default.
        threads: number of threads, which does not change the pictures; by default one per core, or one
            without LLVM.
        say: called with a line of text that names the variant.
        variation: a change of the pictures; states, graph and poses of the file remain the plan's.

    Raises:
        SceneError: the plan has faults, furniture or a package is missing, or the file cannot be written.
        ConfigError: the backbone or its weights are missing, or ``threads`` is below 1.
    """
    out = Path(out)
    if not out.parent.is_dir():
        raise SceneError(f"{out}: there is no folder {out.parent}; make it first")
    raise_faults(f"plan {plan.name!r}", plan_faults(plan))
    network = load_backbone(backbone) if isinstance(backbone, str) else backbone
    catalogue = Catalogue.open() if catalogue is None else catalogue
    plan = plan.completed(catalogue)
    raise_faults(f"plan {plan.name!r}", plan_faults(plan))  # sizes from the catalogue may not fit the room
    room = poses(plan)
    varied = vary_plan(plan, variation, catalogue)
    backend = backends.choose_backend() if backend is None else backend
    mi = backends.load_mitsuba(backend, threads)
    (say or (lambda line: None))(f"{plan.name}: {room.num_states} states, rendering with {backend}")
    report = progress or (lambda what, done, total: None)
    versions = {name: metadata.version(name) for name in ("mitsuba", "mitsuba-oidn")}
    frames = Frames(plan, room, out, {"variant": backend.variant, **versions}, variation)
    report("frames", frames.done, frames.total)

    def renderer_of(plan: Plan) -> Renderer:
        return Renderer(mi, build_scene(mi, plan, catalogue), plan.camera)

    seconds = _render_frames(frames, plan, varied, renderer_of, report)
    scene = capture(
        out,
        plan.name,
        PoseGraph(room.graph, room.location, room.rotation, default_actions(4)),
        frames.read,
        _origin(plan, catalogue),
        attributes=_attributes(varied, catalogue, backend, frames.exposure, variation),
        backbone=network,
        progress=lambda done, total: report("features", done, total),
    )
    frames.remove()
    share = look_alike_share(scene.features.numpy())
    return Rendered(out, room.num_states, str(backend), seconds, share)
