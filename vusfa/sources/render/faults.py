"""Validation of plans."""

from __future__ import annotations

import math
from collections.abc import Iterator

from vusfa.limits import MAX_PICTURE_SIDE, MAX_STATES
from vusfa.sources.render.outline import Rect
from vusfa.sources.render.plan import ROLES, Plan
from vusfa.sources.render.textures import FLOORS, WALLS

__all__ = ["plan_faults"]

_SLACK = 0.05


def _numbers(plan: Plan) -> Iterator[str]:
    grid, camera = plan.grid, plan.camera
    if min(plan.size) <= 0:
        yield f"size: {list(plan.size)} must be three lengths above 0 (width, depth, height)"
    if not grid.step > 0:
        yield f"grid.step: {grid.step} must be above 0"
    elif plan.size[0] * plan.size[1] * grid.headings > MAX_STATES * grid.step**2:
        yield f"grid.step: {grid.step} makes over {MAX_STATES} states; take a longer one or a smaller room"
    if not grid.radius > 0:
        yield f"grid.radius: {grid.radius} must be above 0"
    if grid.headings not in (4, 8):
        yield f"grid.headings: {grid.headings} must be 4 or 8"
    if not 0 < camera.height < plan.size[2]:
        yield f"camera.height: {camera.height} must lie between the floor and the ceiling at {plan.size[2]}"
    if not -89 <= camera.pitch <= 89:
        yield f"camera.pitch: {camera.pitch} must lie in -89..89"
    if not 1 <= camera.fov <= 170:
        yield f"camera.fov: {camera.fov} must lie in 1..170"
    if min(camera.resolution) < 1:
        yield f"camera.resolution: {list(camera.resolution)} must be two whole numbers above 0"
    if max(camera.resolution) > MAX_PICTURE_SIDE:
        yield f"camera.resolution: {list(camera.resolution)} must be at most {MAX_PICTURE_SIDE} per side"
    if camera.samples < 1:
        yield f"camera.samples: {camera.samples} must be 1 or more"
    if camera.exposure is not None and not camera.exposure > 0:
        yield f"camera.exposure: {camera.exposure} must be above 0; leave it out to have it measured"


def _surfaces(plan: Plan) -> Iterator[str]:
    surfaces = plan.surfaces
    floors = [("surfaces.floor", surfaces.floor)]
    floors += [(f"surfaces.zones[{k}].floor", zone.floor) for k, zone in enumerate(surfaces.zones)]
    for where, pattern in floors:
        if pattern not in FLOORS:
            yield f"{where}: {pattern!r} is not known; use one of {', '.join(FLOORS)}"
    for k, pattern in enumerate(surfaces.walls):
        if pattern not in WALLS:
            yield f"surfaces.walls[{k}]: {pattern!r} is not known; use one of {', '.join(WALLS)}"


def _inside(plan: Plan, rect: Rect) -> bool:
    return (
        rect[0] >= -_SLACK
        and rect[1] >= -_SLACK
        and rect[2] <= plan.size[0] + _SLACK
        and rect[3] <= plan.size[1] + _SLACK
    )


def _places(plan: Plan) -> Iterator[str]:
    room = f"the room, {plan.size[0]:g} x {plan.size[1]:g} m"
    rects = [(f"solids[{k}]", solid.rect) for k, solid in enumerate(plan.solids)]
    rects += [(f"surfaces.zones[{k}]", zone.rect) for k, zone in enumerate(plan.surfaces.zones)]
    for where, rect in rects:
        if rect[0] >= rect[2] or rect[1] >= rect[3]:
            yield f"{where}.rect: {list(rect)} must be x0, z0, x1, z1 with x0 < x1 and z0 < z1"
        elif not _inside(plan, rect):
            yield f"{where}.rect: {list(rect)} reaches out of {room}"
    points = [(f"pictures[{k}]", item.at) for k, item in enumerate(plan.pictures)]
    points += [(f"windows[{k}]", item.at) for k, item in enumerate(plan.windows)]
    points += [(f"lights[{k}]", item.at) for k, item in enumerate(plan.lights)]
    points += [(f"furniture[{k}]", item.at) for k, item in enumerate(plan.furniture)]
    for where, (x, z) in points:
        if not _inside(plan, (x, z, x, z)):
            yield f"{where}.at: [{x:g}, {z:g}] is outside {room}"
    for k, item in enumerate(plan.furniture):
        if item.role not in ROLES:
            yield f"furniture[{k}].role: {item.role!r} is not known; use one of {', '.join(ROLES)}"
        if item.size is not None and min(item.size) <= 0:
            yield f"furniture[{k}].size: {list(item.size)} must be three lengths above 0"
        elif item.size is not None and item.role == "floor" and not _inside(plan, item.rect):
            yield f"furniture[{k}] ({item.model}): reaches out of {room}; move it, or make it smaller"


def plan_faults(plan: Plan) -> list[str]:
    """All faults of a plan, one line each, naming the entry, the value and the mend.

    >>> from vusfa.sources.render.plan import Camera, Grid
    >>> plan_faults(Plan("hall", (3.0, 3.0, 2.6), grid=Grid(headings=6), camera=Camera(height=3.0)))
    ['grid.headings: 6 must be 4 or 8', 'camera.height: 3.0 must lie between the floor and ...']
    """
    if not all(math.isfinite(value) for value in (*plan.size, plan.grid.step, plan.camera.height)):
        return ["size, grid.step and camera.height must be finite numbers"]
    return [*_numbers(plan), *_surfaces(plan), *_places(plan)]
