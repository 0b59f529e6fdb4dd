"""``vusfa scenes list``, ``show``, ``check`` and ``compare``: inspect existing scenes."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vusfa.cli.sources import has_graph, scene_paths
from vusfa.errors import SceneError, printable

if TYPE_CHECKING:
    from vusfa.scenes import Scene
    from vusfa.sources.summary import Summary

__all__ = ["register"]


def register(scenes: typer.Typer) -> None:
    """Add the commands to ``vusfa scenes``."""
    scenes.command("list")(list_scenes)
    scenes.command("show")(show)
    scenes.command("check")(check)
    scenes.command("compare")(compare)


def list_scenes(
    sources: Annotated[
        list[str] | None,
        typer.Argument(help="Bundled names, scene files, folders of them.", metavar="SCENE|DIR..."),
    ] = None,
    grouped: Annotated[
        bool, typer.Option("--by-name", help="List instead the share of look-alikes per name of scene.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Write JSON instead of a table.")] = False,
    walk_steps: Annotated[int, typer.Option(min=0, help="Limit of actions of the random walk.")] = 500,
) -> None:
    """List scenes: size, path lengths, success of a random walk.

    Without arguments: the bundled rooms and the scene files of the current folder. Success of the random walk
    is exact, the mean over all goals and all starts that can reach them. A state looks like another if the
    cosine of their features is 0.999 or more. Exit code 1 if a file has faults.

    Examples:

        vusfa scenes list
        vusfa scenes list bathroom my_rooms/ other.h5
        vusfa scenes list --json | jq '.[].random_walk'
        vusfa scenes list my_rooms/ --by-name
    """
    from vusfa.cli.progress import progress
    from vusfa.cli.tables import print_wide, table_of_groups, table_of_scenes
    from vusfa.scenes import Scene, bundled_names
    from vusfa.scenes.places import files_in
    from vusfa.scenes.store import bundled_path
    from vusfa.sources.summary import by_name, summarize

    bundled = {name: bundled_path(name) for name in bundled_names()}
    here = map(Path, filter(has_graph, files_in(".")))
    paths = scene_paths(sources) if sources else [*bundled.values(), *here]
    rows: list[tuple[Path, Summary | SceneError]] = []
    with progress("measuring", len(paths), "scenes") as advance:
        for path in paths:
            try:
                rows.append((path, summarize(Scene.load(path), walk_steps)))
            except SceneError as error:
                rows.append((path, error))
            advance()
    labels = {path: "bundled" if path in bundled.values() else str(path) for path in paths}
    groups = by_name([found for _, found in rows if not isinstance(found, SceneError)])
    if as_json:
        plain = [_as_json(labels[path], found) for path, found in rows]
        typer.echo(json.dumps([asdict(group) for group in groups] if grouped else plain, indent=2))
    elif grouped:
        print_wide(table_of_groups(groups))
    else:
        print_wide(table_of_scenes([(labels[path], found) for path, found in rows], walk_steps))
    faulty = [found for _, found in rows if isinstance(found, SceneError)]
    for fault in faulty:
        typer.echo(f"error: {fault}", err=True)
    if faulty:
        raise typer.Exit(1)


def _as_json(label: str, found: Summary | SceneError) -> dict[str, Any]:
    if isinstance(found, SceneError):
        return {"file": label, "error": str(found)}
    return {"file": label, **found.plain()}


def show(
    scene: Annotated[str, typer.Argument(help="Bundled name or scene file.", show_default=False)],
    output: Annotated[
        Path | None,
        typer.Option("--out", "-o", "--output", help="The PNG; by default SCENE.png, here."),
    ] = None,
    pictures: Annotated[int, typer.Option(min=1, max=100, help="How many pictures to show.")] = 12,
) -> None:
    """Draw a scene as one PNG, pictures and floor map with all poses, and print its provenance.

    The pictures are spread over the room; their numbers are on the map, where +Z is up, every pose is a dart
    that points along its heading, and poses on islands are red.

    Examples:

        vusfa scenes show kitchen
        vusfa scenes show my_room.h5 -o my_room.png --pictures 20
    """
    from vusfa.files import check_file
    from vusfa.scenes import SceneSet
    from vusfa.sources.sheet import save_sheet
    from vusfa.sources.summary import summarize

    target = check_file(output or Path(Path(scene).stem + ".png"))
    (loaded,) = SceneSet.open(scene).scenes
    for line in _description(loaded, summarize(loaded)):
        typer.echo(printable(line))
    typer.echo(f"drawn: {save_sheet(loaded, target, pictures)}")


def _description(scene: Scene, summary: Summary) -> list[str]:
    """Lines with the scene's numbers, its origin, and its other attributes."""
    from vusfa.scenes.provenance import Provenance

    lines = [
        f"{scene.name}: {summary.states} states in {summary.cells} places, islands: {summary.islands}",
        f"actions: {', '.join(scene.actions)}",
        f"features: {summary.features} of each crop, crops: {summary.crops}",
        f"look-alikes: {100 * summary.look_alikes:.1f} % of the states",
        f"shortest paths: mean {summary.mean_path:.1f}, longest {summary.longest_path} actions",
        f"random walk: {100 * summary.random_walk:.1f} % success in {summary.walk_steps} actions",
    ]
    origin = Provenance.of(scene.attributes).attributes()
    lines += ["origin:" + ("" if origin else " unknown")]
    lines += _indented(origin)
    other = Provenance.other(scene.attributes)
    if other:
        lines += ["other attributes:", *_indented(other, longest=20)]
    return lines


def _indented(attributes: dict[str, Any], longest: int | None = None) -> list[str]:
    """Lines of attributes; several lines stand below the name, at most ``longest`` of them."""
    lines = []
    for name, value in attributes.items():
        parts = value if isinstance(value, list) else str(value).splitlines()
        if longest is not None and len(parts) > longest:
            parts = [*parts[:3], f"... ({len(parts)} lines)"]
        label = name.replace("_", " ")
        if len(parts) == 1:
            lines.append(f"  {label}: {parts[0]}")
        else:
            lines += [f"  {label}:", *(f"    {part}" for part in parts)]
    return lines


def check(
    sources: Annotated[
        list[str],
        typer.Argument(
            help="Bundled names, scene files, folders of them.", metavar="SCENE|DIR...", show_default=False
        ),
    ],
    every: Annotated[bool, typer.Option("--all", help="Decode every picture, at any cost of time.")] = False,
) -> None:
    """List all faults of scenes; exit code 1 if there are any.

    The loader's own rules: shapes and types, every move of the graph, the shortest paths by a search of the
    graph, the features, the poses, and the pictures. The header and the end of every picture are checked.
    Where a scene has more pictures than a few seconds suffice to decode, evenly spaced ones are decoded, and
    the line says how many; --all decodes every one.

    Examples:

        vusfa scenes check room.h5
        vusfa scenes check huge.h5 --all
        vusfa scenes check bathroom dumps/
    """
    from vusfa.cli.progress import progress
    from vusfa.scenes import validate

    files = scene_paths(sources)
    found = {}
    with progress("checking", len(files), "files") as advance:
        for path in files:
            found[path] = validate(path, every)
            advance()
    for path, faults in found.items():
        typer.echo(printable("\n".join(faults) if faults else f"{path}: sound{'' if every else _note(path)}"))
    faulty = sum(map(bool, found.values()))
    if faulty:
        typer.echo(f"error: {faulty} of {len(found)} files have faults", err=True)
        raise typer.Exit(1)


def _note(path: Path) -> str:
    """What was not looked at in a sound scene."""
    from vusfa.scenes.pictures import decoded

    some, number = decoded(path)
    return "" if some == number else f" ({some:,} of {number:,} pictures decoded; --all decodes every one)"


def compare(
    scene: Annotated[str, typer.Argument(help="Bundled name or scene file.", show_default=False)],
    other: Annotated[str, typer.Argument(help="Another of the same room.", show_default=False)],
) -> None:
    """Check whether two scenes are the same room, and compare their pictures and features.

    Pictures: the mean absolute difference of values 0 to 255. Features: the cosine per state.
    Exit code 1 if an action leads elsewhere or a pose differs.

    Examples:

        vusfa scenes compare my_bathroom.h5 bathroom
    """
    from vusfa.scenes import SceneSet
    from vusfa.sources.compare import compare as compare_scenes

    found = compare_scenes(SceneSet.open(scene).scenes[0], SceneSet.open(other).scenes[0])
    say = {True: "equal", False: "different"}
    typer.echo(f"graph: {say[found.graph]}")
    typer.echo(f"poses: {say[found.poses]}")
    if found.pixels is None:
        typer.echo("pictures: none in one of them, or not of the same size")
    else:
        typer.echo(f"pictures: {found.pixels:.3f} of 255 apart on average, {found.most_pixels:.3f} at most")
    if found.cosine is None:
        typer.echo("features: not as many")
    else:
        least = f"cosine {found.cosine:.6f} on average, {found.least_cosine:.6f} at least"
        typer.echo(f"features: {say[found.features]}, {least}")
    if not found.same_room:
        raise typer.Exit(1)
