"""``vusfa scenes augment``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vusfa.cli.sources import Force, check_target, scene_path

__all__ = ["register"]


def register(scenes: typer.Typer) -> None:
    """Add the command to ``vusfa scenes``."""
    scenes.command("augment")(augment)


def augment(
    sources: Annotated[
        list[str],
        typer.Argument(
            help="Bundled name or scene file, then further renderings of the same room.", show_default=False
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="File to write; may be the first, with --force.", show_default=False)
    ],
    pictures: Annotated[int, typer.Option(min=1, help="Changed pictures per state.")] = 8,
    strength: Annotated[
        float, typer.Option(help="Factor of all changes; 1 suits a camera held by hand.")
    ] = 1.0,
    seed: Annotated[int, typer.Option(help="Seed of the changes.")] = 0,
    backbone: Annotated[
        str, typer.Option(help="Network of the features, as for encode.")
    ] = "efficientnet-lite0",
    weights: Annotated[Path | None, typer.Option(help="File of the backbone's state dict.")] = None,
    layer: Annotated[str | None, typer.Option(help="Layer of the backbone whose output is taken.")] = None,
    batch: Annotated[int, typer.Option(min=1, help="Pictures at a time.")] = 32,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1 ...")] = "cpu",
    force: Force = False,
) -> None:
    """Give a scene several crops per state, for agents that work away from their own pictures.

    The new file has the features of every rendering as they are, and those of pictures that are changed at
    random: zoomed, shifted, turned, lighter or darker, warmer or cooler, with noise, blur, JPEG and a part
    erased. Training draws a crop of each state anew at every step with env.crop=random; evaluation takes the
    first, the pictures as they were. If stopped, it resumes when the same command is given again.

    Examples:

        vusfa scenes augment bathroom out=bathroom_many.h5

        vusfa scenes augment bathroom bathroom_seed1.h5 bathroom_seed2.h5 out=bathroom_many.h5 pictures=16

        vusfa train preset=replay_search scenes=[bathroom_many.h5] env.crop=random folder=runs/robust
    """
    from vusfa.cli.resumed import resumed
    from vusfa.envs.scene_env import usable_device
    from vusfa.sources.augment import Augmentation, augment_scene
    from vusfa.sources.backbones import load_backbone

    paths = [scene_path(source) for source in sources]
    check_target(out, force)
    usable_device(device)  # before the pictures are read
    changes = Augmentation().scaled(strength)
    network = load_backbone(backbone, weights=weights, layer=layer, device=device)
    with resumed("augmenting", "pictures") as report:
        scene = augment_scene(
            paths,
            out,
            network,
            pictures=pictures,
            augmentation=changes,
            seed=seed,
            batch=batch,
            progress=report,
        )
    typer.echo(f"{out}: {scene.num_states} states, {scene.num_crops} crops of {scene.feature_size} features")
    typer.echo(f"next: vusfa train preset=replay_search scenes=[{out}] env.crop=random", err=True)
