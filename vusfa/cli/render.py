"""``vusfa scenes render``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vusfa.cli.sources import Force, Network, Weights, check_target, say_next
from vusfa.errors import ConfigError

if TYPE_CHECKING:
    from vusfa.sources.render.plan import Plan

__all__ = ["Samples", "Scalar", "Threads", "Width", "find_plan", "register", "with_camera"]

Width = Annotated[
    int | None,
    typer.Option(
        min=16, help="Width of the pictures in pixels; the height follows. By default the plan's, 200."
    ),
]
Samples = Annotated[
    int | None, typer.Option(min=1, help="Light paths per pixel before denoising; by default the plan's, 4.")
]
Scalar = Annotated[
    bool, typer.Option("--scalar", help="Render without LLVM even if it is installed; much slower.")
]
Threads = Annotated[
    int | None,
    typer.Option(min=1, help="Number of threads; by default one per core, or one without LLVM."),
]


def register(scenes: typer.Typer) -> None:
    """Add the command to ``vusfa scenes``."""
    scenes.command("render")(render)


def find_plan(path: Path) -> Plan:
    """The plan of a file, or of a bundled room by its name."""
    from vusfa.sources.render import catalogue
    from vusfa.sources.render.plan_file import load_plan

    bundled = Path(catalogue.__file__).with_name("plans") / f"{path}.yaml"
    return load_plan(bundled if bundled.is_file() and not path.is_file() else path)


def with_camera(plan: Plan, width: int | None, samples: int | None) -> Plan:
    """The plan with pictures of another width, and of the same shape, or with another number of samples."""
    camera = plan.camera
    if width is not None:
        columns, rows = camera.resolution
        camera = replace(camera, resolution=(width, max(1, round(width * rows / columns))))
    return replace(plan, camera=camera if samples is None else replace(camera, samples=samples))


def _plan(plan: Path | None, kind: str | None, flat: str | None, seed: int, cells: int | None) -> Plan:
    from vusfa.sources.render.flat import flat as draw_flat
    from vusfa.sources.render.layout import layout

    if sum(source is not None for source in (plan, kind, flat)) != 1:
        raise ConfigError("say what to render: --plan FILE, --kind KIND or --flat KIND,KIND,...")
    if plan is not None:
        if cells is not None:
            raise ConfigError("--cells belongs to --kind and --flat; a plan has its size")
        return find_plan(plan)
    if flat is not None:
        return draw_flat([room.strip() for room in flat.split(",")], seed, cells)
    assert kind is not None
    return layout(kind, seed, cells)


def render(
    plan: Annotated[
        Path | None, typer.Option(help="Plan of the room: a YAML file, or the name of a bundled room.")
    ] = None,
    kind: Annotated[
        str | None, typer.Option(help="Draw a bathroom, bedroom, kitchen, living_room or hall.")
    ] = None,
    flat: Annotated[
        str | None, typer.Option(help="Draw two to five rooms in a row as one scene: kitchen,hall,bedroom.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed of the plan: the same seed, the same room.")] = 1,
    cells: Annotated[
        int | None,
        typer.Option(help="Number of free places, half a metre apart; by default the kind's own."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", "--output", help="File to write; by default KIND-SEED or the plan's name."
        ),
    ] = None,
    plan_only: Annotated[
        bool, typer.Option("--plan-only", help="Write the plan, a YAML file to look at and change.")
    ] = False,
    vary: Annotated[
        str | None,
        typer.Option(
            help="Change the pictures, not the states: noise, brighter, dimmer, camera, fov, moved, jpeg,"
            " blur, all, train1 to train6, validate1, validate2, or a YAML file of changes."
        ),
    ] = None,
    backbone: Network = "efficientnet-lite0",
    weights: Weights = None,
    width: Width = None,
    samples: Samples = None,
    scalar: Scalar = False,
    threads: Threads = None,
    force: Force = False,
) -> None:
    """Render a room or a flat: from its plan, or drawn and furnished from a kind and a seed.

    Needs `pip install 'vusfa[render]'` and furniture: Debian's package sweethome3d-furniture, or a folder of
    Sweet Home 3D's .sh3f libraries named by SH3D_FURNITURE. With LLVM 16 or later (Debian: libllvm19) it is
    several times faster. --plan-only needs none of these.

    If stopped, it resumes when the same command is given again.

    Examples:

        vusfa scenes render --kind bathroom --seed 7

        vusfa scenes render --kind kitchen --seed 2 --cells 120 --plan-only -o kitchen.yaml

        vusfa scenes render --plan kitchen.yaml -o kitchen.h5

        vusfa scenes render --plan bathroom -o again.h5

        vusfa scenes render --plan bathroom --vary dimmer -o dimmer.h5

        vusfa scenes render --flat kitchen,hall,bedroom,bathroom --cells 500
    """
    from vusfa.sources.render.grid import poses
    from vusfa.sources.render.plan_file import save_plan
    from vusfa.sources.render.variation import PLAIN, load_variation

    if vary is not None and plan_only:
        raise ConfigError("--vary changes pictures, and --plan-only makes none; leave out one of them")
    variation = PLAIN if vary is None else load_variation(vary)
    name = plan.stem if plan is not None else f"{kind or 'flat'}-{seed}"
    target = output or Path(f"{name}.yaml" if plan_only else f"{name}.h5")
    check_target(target, force)
    room = with_camera(_plan(plan, kind, flat, seed, cells), width, samples)
    if plan_only:
        from vusfa.sources.render.catalogue import Catalogue

        if not room.is_complete:
            room = room.completed(Catalogue.open())
        save_plan(room, target)
        found = poses(room)
        typer.echo(
            f"{target}: {found.num_states} states, {len(found.cells)} places, {len(room.models)} models"
        )
        typer.echo(f"next: vusfa scenes render plan={target}", err=True)
        return

    from vusfa.cli.resumed import resumed
    from vusfa.sources.backbones import load_backbone
    from vusfa.sources.render.backend import Backend
    from vusfa.sources.render.room import render_room

    network = load_backbone(backbone, weights=weights)
    with resumed("rendering", "frames") as frames, resumed("encoding", "pictures") as features:
        reports = {"frames": frames, "features": features}
        rendered = render_room(
            room,
            target,
            lambda what, done, total: reports[what](done, total),
            backbone=network,
            backend=Backend("scalar_rgb") if scalar else None,
            threads=threads,
            say=lambda line: typer.echo(line, err=True),
            variation=variation,
        )
    typer.echo(str(rendered))
    say_next(target)
