"""``vusfa scenes from-photos``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from vusfa.cli.sources import Force, check_target, say_next
from vusfa.errors import SceneError

__all__ = ["register"]


class Store(StrEnum):
    """Format of the pictures in a scene file."""

    JPEG = "jpeg"
    RAW = "raw"


def register(scenes: typer.Typer) -> None:
    """Add the command to ``vusfa scenes``."""
    scenes.command("from-photos")(from_photos)


def from_photos(
    folder: Annotated[Path, typer.Argument(help="Photographs, JPEG or PNG.", show_default=False)],
    output: Annotated[
        Path | None,
        typer.Option("--out", "-o", "--output", help="Scene file; by default the folder's name with .h5."),
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="CSV file,x,z,heading; by default poses.csv in the folder.")
    ] = None,
    edges: Annotated[
        Path | None, typer.Option(help="CSV state,action,next; by default edges.csv in the folder.")
    ] = None,
    step: Annotated[
        float | None, typer.Option(help="Metres between neighbouring places; inferred when not given.")
    ] = None,
    turn: Annotated[
        int | None,
        typer.Option(help="Degrees between headings, 45, 90, 180 or 360; inferred when not given."),
    ] = None,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the stored pictures.")] = "200x150",
    store: Annotated[Store, typer.Option(help="Format of the stored pictures.")] = Store.JPEG,
    features: Annotated[
        Path | None, typer.Option(help="Existing features: .npy, (N, F) or (N, C, F), in the table's order.")
    ] = None,
    backbone: Annotated[
        str, typer.Option(help="Network that computes features otherwise; see `vusfa scenes encode --help`.")
    ] = "efficientnet-lite0",
    weights: Annotated[Path | None, typer.Option(help="File of the network's weights.")] = None,
    name: Annotated[str | None, typer.Option(help="The scene's name; by default the file's.")] = None,
    by: Annotated[str | None, typer.Option(help="Who took the photographs.")] = None,
    licence: Annotated[list[str] | None, typer.Option(help="Licence; may be given more than once.")] = None,
    credit: Annotated[list[str] | None, typer.Option(help="Person to credit; may be repeated.")] = None,
    force: Force = False,
) -> None:
    """Make a scene from photographs that were taken at known poses.

    poses.csv lists the poses: `file,x,z,heading`, metres and degrees, 0 along +Z, 90 along +X. Poses on a
    grid, at most a quarter of a step off, are joined by MoveForward, RotateRight, RotateLeft and
    MoveBackward. For anything else, or where a wall stands between two poses, edges.csv says which action
    leads where: `state,action,next`, with the pictures' names as states; poses are optional then.

    If stopped while it computes features, it resumes when the same command is given again.

    Examples:

        vusfa scenes from-photos my_flat/

        vusfa scenes from-photos my_flat/ -o flat.h5 --by "A. Fan" --licence CC-BY-4.0

        vusfa scenes from-photos lab/ --edges moves.csv --features lab.npy
    """
    from vusfa.cli.progress import progress
    from vusfa.cli.resumed import resumed
    from vusfa.scenes.provenance import Provenance, this_tool, today
    from vusfa.sources import backbones
    from vusfa.sources.capture import capture
    from vusfa.sources.photos import lay_out, read_features, read_photos

    target = output or Path(f"{folder.resolve().name}.h5")
    check_target(target, force)
    width, height = _size(size)
    layout = lay_out(folder, poses, edges, step=step, turn=turn)
    # One text: HDF5 has room for some thousand only where they are a list.
    attributes = {"photographs": "\n".join(layout.files)}
    encoding: dict[str, Any]
    if features is not None:
        encoding = {"features": read_features(features, len(layout.files))}
        attributes["feature"] = f"given, {features.name}"
    else:
        # loaded before the pictures are read, so that a missing one is reported at once
        encoding = {"backbone": backbones.load_backbone(backbone, weights=weights)}
    with progress("reading pictures", len(layout.files), "pictures") as advance:
        pictures = read_photos(folder, layout.files, width, height, raw=store == Store.RAW, advance=advance)
    origin = Provenance(
        this_tool("scenes from-photos"),
        by,
        today(),
        licences=tuple(licence or ()),
        credits=tuple(credit or ()),
    )
    with resumed("encoding", "pictures") as report:
        scene = capture(
            target,
            name or target.stem,
            layout,
            pictures,
            origin,
            attributes=attributes,
            progress=report,
            **encoding,
        )
    typer.echo(f"{target}: {scene.num_states} states, {layout.found}")
    _warn(layout.left_out, scene)
    say_next(target)


def _size(size: str) -> tuple[int, int]:
    """
    >>> _size("200x150")
    (200, 150)
    """
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal() and 0 < int(width) <= 4096 and 0 < int(height) <= 4096):
        raise SceneError(f"--size is {size!r}; write WIDTHxHEIGHT in pixels, 200x150")
    return int(width), int(height)


def _warn(left_out: tuple[str, ...], scene: Any) -> None:
    """Print notes on likely oversights."""
    if left_out:
        some = ", ".join(left_out[:3]) + (", ..." if len(left_out) > 3 else "")
        typer.echo(f"note: {len(left_out)} pictures are in no table and were left out: {some}", err=True)
    if scene.islands:
        cut_off = sum(map(len, scene.islands))
        typer.echo(
            f"note: {cut_off} states are cut off from the others, on {len(scene.islands)} islands;"
            f" see them in red: vusfa scenes show",
            err=True,
        )
