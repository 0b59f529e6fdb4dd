"""``vusfa film``: one walk of a trained agent as a GIF."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vusfa.cli.deploy import AGENT

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("film", rich_help_panel="Agents")(film)


def film(
    agent: Annotated[str, AGENT],
    out: Annotated[Path, typer.Option(help="GIF to write; replaced if it exists.")] = Path("walk.gif"),
    scene: Annotated[str | None, typer.Option(help="Name of the room; by default the agent's first.")] = None,
    goal: Annotated[
        int | None, typer.Option(help="State id; by default the trained goal with the longest path.")
    ] = None,
    start: Annotated[
        int | None, typer.Option(help="State id; by default the one farthest from the goal.")
    ] = None,
    attempts: Annotated[int, typer.Option(min=1, help="Walks, of which the shortest is filmed.")] = 10,
    max_steps: Annotated[int, typer.Option(min=1, help="Limit of actions per walk.")] = 500,
    seed: Annotated[int, typer.Option(help="Seed of the sampled actions.")] = 0,
    scale: Annotated[int, typer.Option(min=1, max=4, help="Enlargement of the room's pictures.")] = 2,
) -> None:
    """Film one walk of an agent as GIF: what it sees, the picture of its goal, and the map.

    Examples:

        vusfa film vusfa --scene kitchen

        vusfa film runs/first --goal 12 --start 140 --out walk.gif
    """
    from vusfa.deploy.agents import open_agent
    from vusfa.files import check_file
    from vusfa.report.film import draw_film, farthest_pair, record_walk, write_gif
    from vusfa.training import make_observation

    check_file(out)
    loaded = open_agent(agent)
    first, last = farthest_pair(loaded.scenes, 0 if scene is None else scene, start, goal, loaded.goals)
    trail = record_walk(
        loaded.agent.get_policy_operator(),
        loaded.scenes,
        first,
        last,
        max_steps=max_steps,
        history=loaded.agent.config["history"],
        attempts=attempts,
        seed=seed,
        observe=make_observation(loaded.agent, loaded.scenes),
    )
    write_gif(out, draw_film(loaded.scenes, trail, last, scale))
    name = loaded.scenes.names[int(loaded.scenes.scene_id[last])]
    ids = [int(loaded.scenes.local_id(state)) for state in (first, last)]
    shortest = int(loaded.scenes.distance(first, last))
    ended = "reached" if trail[-1] == last else "not reached"
    typer.echo(
        f"{out}: {name}, from state {ids[0]} to {ids[1]}, {ended} in {len(trail) - 1} actions (shortest path"
        f" {shortest})"
    )
    typer.echo(
        f"next: open {out}; another room with scene=, another goal with goal="
        if trail[-1] == last
        else "next: more attempts=, or another goal=; the trained goals are the easiest",
        err=True,
    )
