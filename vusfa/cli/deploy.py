"""``vusfa run`` and ``vusfa export``: deployment of a trained agent."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vusfa.cli.sources import Force, check_target

if TYPE_CHECKING:
    from vusfa.deploy import Navigator

__all__ = ["AGENT", "register"]

#: The argument of commands that take an agent.
AGENT = typer.Argument(
    help="Checkpoint or folder of vusfa train, or a name of vusfa pretrained list.",
    metavar="CHECKPOINT",
    show_default=False,
)
_BACKBONE = typer.Option(help="Network of the rooms' features, if their files name none: timm:MODEL, ...")
_WEIGHTS = typer.Option(help="File of the backbone's state dict.")
_LAYER = typer.Option(help="Layer of the backbone whose output is taken.")


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("run", rich_help_panel="Agents")(run)
    app.command("export", rich_help_panel="Agents")(export)


def _load(
    agent: str, backbone: str | None, weights: Path | None, layer: str | None, **options: Any
) -> Navigator:
    from vusfa.deploy import Navigator
    from vusfa.errors import ConfigError
    from vusfa.sources.backbones import load_backbone

    if backbone is None and (weights or layer):
        raise ConfigError("--weights and --layer belong to a backbone; name it with --backbone")
    network = None if backbone is None else load_backbone(backbone, weights=weights, layer=layer)
    return Navigator.load(agent, backbone=network, **options)


def run(
    agent: Annotated[str, AGENT],
    goal: Annotated[Path, typer.Option(help="Picture taken at the goal.", show_default=False)],
    camera: Annotated[
        str,
        typer.Option(
            help="Folder of pictures, number of a camera, film, or http address.", show_default=False
        ),
    ],
    scene: Annotated[str | None, typer.Option(help="Name of the room; recognized when not given.")] = None,
    greedy: Annotated[
        bool, typer.Option("--greedy", help="Take the most probable action, without sampling.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the sampled actions.")] = 0,
    threshold: Annotated[
        float | None, typer.Option(help="Similarity that counts as arrived; calibrated when not given.")
    ] = None,
    crop: Annotated[bool, typer.Option("--crop", help="Cut pictures to the rooms' aspect ratio.")] = False,
    every: Annotated[float, typer.Option(min=0, help="Seconds to wait after each action.")] = 0.0,
    max_steps: Annotated[int, typer.Option(min=1, help="Stop after this many pictures.")] = 500,
    backbone: Annotated[str | None, _BACKBONE] = None,
    weights: Annotated[Path | None, _WEIGHTS] = None,
    layer: Annotated[str | None, _LAYER] = None,
) -> None:
    """Print the action for each picture of a camera, until the goal is reached or the pictures end.

    Each line has the picture's number, the action, its probability, and the similarity of the picture with
    the goal's. Cameras and films need OpenCV (`pip install opencv-python-headless`); folders and http
    addresses do not.

    Examples:

        vusfa run run/checkpoint.pt --goal goal.jpg --camera walk/

        vusfa run run/checkpoint.pt --goal goal.jpg --camera 0 --crop --every 2

        vusfa run run/checkpoint.pt --goal goal.jpg --camera http://192.168.0.17:8080/video
    """
    from vusfa.deploy.cameras import open_camera

    navigator = _load(
        agent,
        backbone,
        weights,
        layer,
        scene=scene,
        sample=not greedy,
        seed=seed,
        threshold=threshold,
        crop=crop,
    )
    room = navigator.goal(goal)
    pictures = open_camera(camera)
    typer.echo(f"room: {room}; arrived from similarity {navigator.threshold:.2f} on")
    number = 0
    for number, picture in enumerate(pictures, 1):
        found = navigator.act(picture)
        action = "arrived" if found.arrived else found.name
        typer.echo(
            f"{number:>4}  {action:<12}  {found.confidence:.2f}  similarity {navigator.similarity:.2f}"
        )
        if found.arrived:
            typer.echo(f"arrived, with picture {number}")
            typer.echo(f"next: vusfa export {agent} agent.onnx", err=True)
            return
        if number == max_steps:
            break
        time.sleep(every)
    typer.echo(
        f"not arrived: the pictures ended after {number}"
        if number < max_steps
        else f"not arrived in {number}"
    )
    typer.echo(
        "next: a camera whose pictures follow the actions, or a lower threshold="
        if number < max_steps
        else "next: more max_steps=, or a lower threshold=",
        err=True,
    )


def export(
    agent: Annotated[str, AGENT],
    target: Annotated[Path, typer.Argument(help="ONNX file to write.", show_default=False)],
    scene: Annotated[str | None, typer.Option(help="Room of the walk that is compared.")] = None,
    threshold: Annotated[
        float | None, typer.Option(help="Similarity that counts as arrived; calibrated when not given.")
    ] = None,
    backbone: Annotated[str | None, _BACKBONE] = None,
    weights: Annotated[Path | None, _WEIGHTS] = None,
    layer: Annotated[str | None, _LAYER] = None,
    force: Force = False,
) -> None:
    """Write backbone, normalization and agent as one ONNX file, and compare it with PyTorch over a walk.

    Its inputs, outputs and metadata are described in docs/deploy.md; examples/deploy/run_onnx.py runs it
    without torch. Needs `pip install 'vusfa[deploy]'`.

    Examples:

        vusfa export run/checkpoint.pt agent.onnx
    """
    from vusfa.deploy.export import export_onnx, largest_difference

    check_target(target, force)
    navigator = _load(agent, backbone, weights, layer, scene=scene, threshold=threshold)
    export_onnx(navigator, target)
    typer.echo(f"{target}: {target.stat().st_size / 1e6:.1f} MB, model {navigator.agent.config['model']}")
    index = 0 if scene is None else navigator.scenes.scene_index(scene)
    room = navigator.scenes.scenes[index]
    if room.has_pictures:
        goal, *walk = room.pictures(list(range(min(8, room.num_states))))
        apart = largest_difference(navigator, target, goal, walk)
        typer.echo(
            f"ONNX Runtime and PyTorch differ by {apart:.1e} at most over {len(walk)} pictures of {room.name}"
        )
    typer.echo(
        f"next: python run_onnx.py {target} goal.jpg FOLDER (examples/deploy, without torch)", err=True
    )
