"""``vusfa pretrained``: the agents that come with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vusfa.cli.functions import App

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = App()
    group.command("list")(list_agents)
    group.command("show")(show)
    group.command("make")(make)
    app.add_typer(
        group,
        name="pretrained",
        help="Look at the trained agents that come with the package.",
        rich_help_panel="Agents",
    )


def list_agents() -> None:
    """List the pretrained agents: model, size, exact success and SPL over all goals.

    Examples:

        vusfa pretrained list
    """
    from vusfa.deploy.agents import PRETRAINED, pretrained_names
    from vusfa.deploy.cards import card_head

    names = pretrained_names()
    width = max(map(len, names))
    for name in names:
        facts = card_head((PRETRAINED / f"{name}.md").read_text(encoding="utf-8"))["vusfa"]
        exact = facts["exact"]["all"]
        success, spl = (100 * exact[metric][0] for metric in ("success_500", "spl"))
        typer.echo(
            f"{name:<{width}}  {facts['bytes'] / 1e6:.1f} MB  {facts['frames']:>9,} frames"
            f"  success {success:5.1f} %  SPL {spl:5.1f} %  (all goals, 500 actions, exact)"
        )
    typer.echo(
        "next: vusfa pretrained show NAME; vusfa film NAME; vusfa run NAME goal=PICTURE camera=FOLDER",
        err=True,
    )


def show(
    name: Annotated[str, typer.Argument(help="Name of vusfa pretrained list.", show_default=False)],
) -> None:
    """Print the model card of a pretrained agent.

    Examples:

        vusfa pretrained show vusfa
    """
    from vusfa.deploy.agents import PRETRAINED, check_name

    typer.echo((PRETRAINED / f"{check_name(name)}.md").read_text(encoding="utf-8"))


def make(
    cells: Annotated[
        list[Path], typer.Argument(help="Folders of results.", metavar="RUN...", show_default=False)
    ],
    runs: Annotated[Path, typer.Option(help="Folder of the trainings of these results.")] = Path("runs"),
    commit: Annotated[str, typer.Option(help="Commit of the code that trained.", show_default=False)] = "",
    out: Annotated[
        Path | None, typer.Option(help="Folder to write to; the package's own by default.")
    ] = None,
) -> None:
    """Make pretrained agents and their model cards from results and the checkpoints that they name.

    Weights are rounded to float16. The rounded agent is evaluated exactly, as its run was, and nothing is
    written if a mean differs.

    Examples:

        vusfa pretrained make results/table1/vusfa-0 results/hindsight/vusfa-0 --runs runs --commit 8642415
    """
    from vusfa.deploy.agents import PRETRAINED
    from vusfa.deploy.cards import make_pretrained

    for cell in cells:
        path = make_pretrained(cell, runs, commit, out or PRETRAINED)
        typer.echo(f"{path}: {path.stat().st_size / 1e6:.1f} MB, card {path.with_suffix('.md').name}")
