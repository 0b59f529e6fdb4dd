"""The page in a real browser: it draws itself, its controls change what is shown, it asks for nothing."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from vusfa.report import Options, read_run, write_report
from vusfa.report.runs import LoggedRun
from vusfa.scenes import Scene
from vusfa.scenes.markov import arrival_probability

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def opened(chromium: Any, page: Path) -> Iterator[tuple[Any, list[str], list[str]]]:
    """The page, what it complained of, and what it asked for."""
    complaints: list[str] = []
    asked: list[str] = []
    context = chromium.new_context(viewport={"width": 1280, "height": 900}, color_scheme="light")
    tab = context.new_page()
    tab.on("console", lambda message: complaints.append(f"{message.type}: {message.text}"))
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(page.as_uri())
    tab.wait_for_selector("html[data-ready=yes]")
    yield tab, complaints, asked
    context.close()


@pytest.fixture
def tab(opened: tuple[Any, list[str], list[str]]) -> Iterator[Any]:
    """The page; a test fails when it complains."""
    tab, complaints, _ = opened
    yield tab
    assert complaints == []


def points(tab: Any, chart: str) -> Any:
    """What a chart of Plotly shows."""
    return tab.evaluate(
        f"document.getElementById('{chart}').data.map((trace) => [trace.name, trace.x, trace.y])"
    )


def until(tab: Any, condition: str) -> None:
    """Wait until the page says so; its own rule keeps Playwright from waiting inside it."""
    give_up = time.monotonic() + 20
    while not tab.evaluate(condition):
        assert time.monotonic() < give_up, condition
        time.sleep(0.02)


def colours(tab: Any, selector: str) -> list[str]:
    return tab.evaluate(f"[...document.querySelectorAll('{selector} path.s')].map((path) => path.style.fill)")


def test_it_draws_all_its_parts(tab: Any, runs: list[LoggedRun]):
    assert tab.title() == "A <b>title</b> & </script>"
    assert tab.inner_text("h1") == "A <b>title</b> & </script>"
    for chart in ("overview", "distance-plot", "curves"):
        assert tab.locator(f"#{chart} .main-svg").count() >= 1, chart
        assert tab.evaluate(f"[$('{chart}').clientHeight >= $('{chart}').layout.height]") == [True], chart
        assert tab.locator(f"#{chart} path.point, #{chart} path.js-line").count() >= 2, chart
    assert tab.locator("#run-table tbody tr").count() == len(runs)
    names = tab.locator("#summary tbody tr td:first-child").all_inner_texts()
    assert names == ["vusfa", "gvf", "random walk", "shortest path"]
    assert tab.locator("#map-grid .map-row").count() == 3  # two models and the random walk
    assert len(colours(tab, "#map-grid .map-row:first-child")) == 176 + 404
    assert len(set(colours(tab, "#x-map"))) > 20


def test_the_table_shows_what_the_csv_holds(tab: Any, page: Path):
    with open(page.parent / "page_tables" / "summary.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for goals, scene in (("unseen", "mean of scenes"), ("trained", "bedroom"), ("all", "mean of states")):
        tab.select_option("#subset", goals)
        tab.select_option("#scene", scene)
        (row,) = (r for r in rows if (r["model"], r["goals"], r["scene"]) == ("vusfa", goals, scene))
        cells = tab.locator("#summary tbody tr:first-child td").all_inner_texts()
        mean, low, high = (f"{100 * float(row[f'success_20{end}']):.1f}" for end in ("", "_from", "_to"))
        assert cells[1] == row["seeds"] == "2"
        assert cells[2].split() == [mean, low, "–", high]


@pytest.mark.parametrize(
    ("control", "chart"),
    [
        ("measure", "overview"),
        ("subset", "overview"),
        ("scene", "overview"),
        ("distance-measure", "distance-plot"),
        ("curve", "curves"),
        ("curve-scene", "curves"),
        ("curve-axis", "curves"),
        ("smooth", "curves"),
    ],
)
def test_controls_change_the_charts(tab: Any, control: str, chart: str):
    tab.select_option("#curve", "length")
    tab.select_option(f"#{control}", index=0)
    before = points(tab, chart)
    tab.select_option(f"#{control}", index=tab.locator(f"#{control} option").count() - 1)
    assert points(tab, chart) != before


def test_the_map_shows_success_by_goal(tab: Any, runs: list[LoggedRun]):
    tab.select_option("#map-measure", "success_20")
    shown = colours(tab, "#map-grid .map-row:nth-child(2)")[:176]  # gvf in the bathroom
    episodes = runs[2].episodes
    assert episodes is not None
    reached = {
        int(goal): bool(ok)
        for goal, ok, scene in zip(episodes.goal, episodes.success, episodes.scene, strict=True)
        if scene == 0
    }
    best, worst = "rgb(253, 231, 37)", "rgb(68, 1, 84)"
    assert [colour == best for colour in shown] == [reached[goal] for goal in range(176)]
    assert set(shown) <= {best, worst}
    assert tab.locator("#map-unknown").is_hidden()  # every state was a goal
    tab.select_option("#map-measure", "spl")
    assert len(set(colours(tab, "#map-grid .map-row:nth-child(2)")[:176])) > 2


def test_the_explorer_follows_its_controls(tab: Any):
    tab.select_option("#x-agent", label="vusfa, seed 0")
    tab.select_option("#x-scene", "bathroom")
    tab.select_option("#x-goal", index=0)
    layers: dict[str, list[str]] = {}
    for layer in ("value", "occupancy", "arrive", "psi0", "psi1", "psi2", "sure", "togo"):
        tab.select_option("#x-layer", layer)
        layers[layer] = colours(tab, "#x-map")
    assert len({tuple(found) for found in layers.values()}) == len(layers)
    assert tab.locator("#x-map .arrow").count() > 0
    tab.uncheck("#x-arrows")
    assert tab.locator("#x-map .arrow").count() == 0
    tab.check("#x-arrows")
    tab.select_option("#x-layer", "value")
    target = tab.get_attribute("#x-target", "src")
    tab.select_option("#x-goal", index=1)
    assert colours(tab, "#x-map") != layers["value"]
    assert tab.get_attribute("#x-target", "src") != target
    tab.select_option("#x-scene", "bedroom")
    assert len(colours(tab, "#x-map")) == 404
    before = colours(tab, "#x-map")
    tab.select_option("#x-agent", label="gvf, seed 0")
    assert colours(tab, "#x-map") != before
    assert "has no ψ" in tab.inner_text("#x-note")
    assert not any("ψ" in text for text in tab.locator("#x-layer option").all_inner_texts())
    tab.select_option("#x-agent", label="vusfa, seed 0")
    share = tab.evaluate("viewNow().explained[0]")
    (named,) = (text for text in tab.locator("#x-layer option").all_inner_texts() if "component 1" in text)
    assert named == f"ψ, principal component 1 ({100 * share:.0f}\u00a0% of its variance)"


def test_the_page_computes_what_the_package_computes(tab: Any):
    """Arrival by the backward equation, occupancy by the forward one: their own numbers on both sides."""
    tab.select_option("#x-agent", label="vusfa, seed 0")
    tab.select_option("#x-scene", "bathroom")
    goal, graph = int(tab.input_value("#x-goal")), Scene.bundled("bathroom").graph
    shares = torch.tensor(tab.evaluate("[...sharesNow()]")).view(1, -1, 4).double()
    shares /= shares.sum(-1, keepdim=True)
    found = torch.tensor(tab.evaluate("[...arrivalNow()]"))
    assert torch.allclose(found, arrival_probability(graph, shares, goal, 30)[0].float(), atol=1e-3)
    start = tab.evaluate("at.way[0]")
    visits = torch.tensor(tab.evaluate(
        "[...occupancy(drawing('bathroom'), sharesNow(), 4, at.way[0], goalNow(), 0.9, 1000)]"
    )).double()  # fmt: skip
    stay = torch.arange(len(graph))[:, None].expand_as(graph)
    moves = torch.zeros(len(graph), len(graph)).double()
    moves.scatter_add_(1, torch.where(graph < 0, stay, graph), shares[0])
    moves[goal] = 0  # where the episode ends
    expected = torch.linalg.inv(torch.eye(len(graph)).double() - 0.9 * moves)[start]
    assert torch.allclose(visits, expected, atol=1e-3)


def test_the_first_goal_is_one_that_is_reached(tab: Any):
    tab.select_option("#x-agent", label="vusfa, seed 0")
    shares = tab.evaluate("ranked().slice(0, TRIED).map(reached)")
    assert tab.evaluate("bestGoal().share") == max(shares)
    assert tab.evaluate("worstGoal().share") <= min(shares)


def test_a_link_opens_a_state(tab: Any, page: Path):
    goal = tab.evaluate("DATA.goals.bedroom[5]")
    tab.evaluate(f"location.hash = '#agent=gvf%2C+seed+0&scene=bedroom&goal={goal}&color=arrive&from=17'")
    until(tab, f"document.getElementById('x-goal').value === '{goal}' && at.way[0] === 17")
    assert tab.evaluate("[agentNow().name, sceneNow(), $('x-layer').value, at.way[0]]") == [
        "gvf, seed 0",
        "bedroom",
        "arrive",
        17,
    ]
    assert tab.locator("#x-notice").is_hidden()
    way = tab.evaluate("at.way")
    tab.select_option("#x-layer", "value")
    assert tab.evaluate("location.hash") == f"#agent=gvf%2C+seed+0&scene=bedroom&goal={goal}&from=17"
    tab.evaluate("show({agent: 0, scene: 'bathroom'}); readLink()")
    assert tab.evaluate("at.way") == way  # the same link, the same episode


@pytest.mark.parametrize(
    ("link", "said"),
    [
        ("scene=cellar", "scene “cellar” (there are bathroom, bedroom)"),
        ("scene=bathroom&goal=176", "goal “176”"),
        ("goal=-1&color=<b>", "goal “-1”; color “<b>”"),
        ("agent=nobody", "agent “nobody” (there are vusfa, seed 0, gvf, seed 0)"),
    ],
)
def test_a_link_to_what_is_not_there(tab: Any, link: str, said: str):
    tab.evaluate(f"location.hash = '#{link}'")
    until(tab, "!document.getElementById('x-notice').hidden")
    assert said in tab.inner_text("#x-notice")
    assert len(colours(tab, "#x-map")) in (176, 404)
    tab.evaluate("notice(''); history.replaceState(null, '', '#')")


def test_a_goal_that_is_not_on_the_page_opens_the_nearest(tab: Any):
    wanted = tab.evaluate("[...Array(404).keys()].find((state) => !DATA.goals.bedroom.includes(state))")
    row = tab.locator("#map-grid .map-row").first
    row.locator(".floor").nth(1).locator(f'path.s[data-i="{wanted}"]').dispatch_event("click")
    assert f"the nearest one to {wanted}" in tab.inner_text("#x-notice")
    near = int(tab.input_value("#x-goal"))
    room, goals = Scene.bundled("bedroom"), tab.evaluate("DATA.goals.bedroom")
    far = (room.location[goals] - room.location[wanted]).norm(dim=1)
    assert (room.location[near] - room.location[wanted]).norm() <= far.min() + 0.3


def test_the_first_minute(tab: Any):
    for step, layer in ((1, "value"), (2, "occupancy"), (3, "arrive")):
        tab.click(f"#guide-{step}")
        assert tab.input_value("#x-layer") == layer
        assert tab.get_attribute(f"#guide-{step}", "aria-pressed") == "true"
        assert "goal" in tab.inner_text("#guide-say")
    tab.evaluate("pause()")


def test_keys(tab: Any):
    tab.evaluate("pause(); document.activeElement.blur()")
    tab.select_option("#x-agent", label="vusfa, seed 0")
    tab.select_option("#x-scene", "bathroom")
    tab.evaluate("document.activeElement.blur()")
    goal, layer = tab.input_value("#x-goal"), tab.input_value("#x-layer")
    for key, away in (("g", "#x-goal"), ("c", "#x-layer")):
        before = tab.input_value(away)
        tab.keyboard.press(key)
        assert tab.input_value(away) != before
        tab.keyboard.press(key.upper())
        assert tab.input_value(away) == before
    assert (goal, layer) == (tab.input_value("#x-goal"), tab.input_value("#x-layer"))
    tab.keyboard.press(".")
    assert tab.input_value("#x-step") == "1"
    tab.keyboard.press(",")
    assert tab.input_value("#x-step") == "0"
    tab.focus("#x-map")
    start, room = tab.evaluate("at.way[0]"), Scene.bundled("bathroom")
    tab.keyboard.press("ArrowRight")
    tab.keyboard.press("ArrowLeft")
    assert tab.evaluate("at.way") == [start, int(room.graph[start, 1]), start]
    assert "You have taken 2 actions" in tab.inner_text("#x-status")
    tab.keyboard.press("Enter")
    assert tab.evaluate("[at.way[0], at.yours]") == [start, False]


def test_labels_of_the_baselines_do_not_overlap(tab: Any):
    for control, value in (("measure", "success_20"), ("subset", "unseen"), ("scene", "mean of scenes")):
        tab.select_option(f"#{control}", value)
    tab.evaluate("""() => {
      window.kept = [...DATA.tables.summary];
      for (const row of kept.filter((row) => row.model === "random walk"))
        for (const model of ["untrained network", "another baseline", "a third"])
          DATA.tables.summary.push({ ...row, model });
      drawOverview();
    }""")
    labels = "[...document.querySelectorAll('#overview .annotation')]"
    boxes = tab.evaluate(f"{labels}.map((one) => one.getBoundingClientRect().toJSON())")
    assert len(boxes) == 5
    for one, other in itertools.combinations(boxes, 2):
        apart = one["right"] <= other["left"] + 1 or other["right"] <= one["left"] + 1
        assert apart or one["bottom"] <= other["top"] + 2 or other["bottom"] <= one["top"] + 2
    tab.evaluate("() => { DATA.tables.summary = kept; drawOverview(); }")


def test_walks_go_along_the_graph_with_their_pictures(tab: Any):
    tab.select_option("#x-agent", label="vusfa, seed 0")
    tab.select_option("#x-scene", "bathroom")
    graph = Scene.bundled("bathroom").graph
    for goal in range(3):
        tab.select_option("#x-goal", index=goal)
        for walk in range(2):
            tab.select_option("#x-walk", str(walk))
            way = tab.evaluate("at.way")
            assert 1 <= len(way) - 1 <= 30
            for here, there in itertools.pairwise(way):
                assert there in [*graph[here].tolist(), here]
            arrives = tab.inner_text("#x-status").startswith(f"Arrives after {len(way) - 1} action")
            assert arrives == (way[-1] == int(tab.input_value("#x-goal")))
    tab.locator("#x-step").fill("1")
    assert tab.inner_text("#x-count").startswith("1 of ")
    for image in ("x-view", "x-target"):
        until(tab, f"document.getElementById('{image}').naturalWidth === 200")
    tab.click("#x-play")
    until(tab, "Number(document.getElementById('x-step').value) >= 3")
    tab.click("#x-play")


def test_a_pose_that_is_pressed_begins_a_walk(tab: Any):
    tab.select_option("#x-agent", label="vusfa, seed 0")
    tab.select_option("#x-scene", "bathroom")
    tab.select_option("#x-goal", index=0)
    start = 40 if tab.input_value("#x-goal") != "40" else 41
    tab.locator(f'#x-map path.s[data-i="{start}"]').click(force=True)
    assert tab.evaluate("at.way[0]") == start
    assert tab.input_value("#x-walk") == "own"
    assert tab.locator("#tip").is_visible()


def test_a_goal_pressed_on_a_map_opens_in_the_explorer(tab: Any):
    goals = json.loads(
        tab.inner_text("#data") or tab.evaluate("document.getElementById('data').textContent")
    )["goals"]
    goal = goals["bedroom"][3]
    row = tab.locator("#map-grid .map-row").nth(1)
    row.locator(".floor").nth(1).locator(f'path.s[data-i="{goal}"]').dispatch_event("click")
    assert tab.input_value("#x-scene") == "bedroom"
    assert tab.input_value("#x-goal") == str(goal)
    assert tab.evaluate("agentNow().model") == "gvf"


def test_light_and_dark(tab: Any):
    def looks() -> Any:
        return tab.evaluate(
            "[getComputedStyle(document.body).backgroundColor, $('curves').layout.font.color]"
        )

    light = looks()
    tab.click("#theme")
    dark = looks()
    tab.click("#theme")
    assert dark[0] != light[0]
    assert dark[1] != light[1]
    assert looks() == light


@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_is_wider_than_the_screen(tab: Any, width: int):
    tab.set_viewport_size({"width": width, "height": 800})
    until(tab, f"document.querySelector('#overview .main-svg').clientWidth < {width}")
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    button = tab.evaluate("document.getElementById('theme').getBoundingClientRect().toJSON()")
    assert 0 < button["left"] < button["right"] <= width


def test_nothing_is_fetched_from_outside(opened: tuple[Any, list[str], list[str]], page: Path):
    tab, complaints, asked = opened
    outside = [url for url in asked if url != page.as_uri() and not re.match(r"(data|blob):", url)]
    assert outside == []
    # and the page's own rule would forbid it
    refused = tab.evaluate("fetch('http://127.0.0.1:9/x').then(() => 'fetched', () => 'refused')")
    assert refused == "refused"
    assert any("Content Security Policy" in complaint for complaint in complaints)
    complaints.clear()


def fresh_tab(chromium: Any, page: Path) -> tuple[Any, list[str]]:
    """A tab with the page, and all that it complains of."""
    complaints: list[str] = []
    tab = chromium.new_page()
    tab.on("console", lambda message: complaints.append(message.text))
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.goto(page.as_uri())
    tab.wait_for_selector("html[data-ready=yes]")
    return tab, complaints


@pytest.mark.parametrize("options", [["agent.history=2"], ["agent.memory=lstm"]])
def test_an_agent_with_a_past(
    chromium: Any, train_run: Callable[..., Path], scene_file: Path, tmp_path: Path, options: list[str]
):
    """Its next action does not follow from a pose alone: no walks are drawn in the page."""
    folder = train_run(tmp_path / "run", [f"scenes=[{scene_file}]", "env.goals=[3,9]", *options])
    write_report([read_run(folder)], tmp_path / "page.html", Options(goals_per_scene=4, max_steps=9))
    tab, complaints = fresh_tab(chromium, tmp_path / "page.html")
    assert len(colours(tab, "#x-map")) == 16
    assert tab.locator("#x-again").is_disabled()
    assert "at most 4 goals per scene." in tab.inner_text("#about")
    way = tab.evaluate("at.way")
    tab.locator("#x-map path.s").first.dispatch_event("click")
    assert tab.evaluate("at.way") == way
    assert tab.locator("#map-grid .map-row").count() == 2
    assert "arriving" not in tab.inner_text("#x-layer")
    for step in (1, 2, 3):
        tab.click(f"#guide-{step}")
    tab.focus("#x-map")
    tab.keyboard.press("ArrowLeft")
    assert tab.locator("#x-map .edge").count() == 1  # no plan is known: the steps that are blocked
    assert complaints == []
    tab.close()


def test_a_page_without_an_explorer_promises_none(chromium: Any, runs: list[LoggedRun], tmp_path: Path):
    bare = [dataclasses.replace(runs[0], label="my_model", checkpoint=None)]
    write_report(bare, tmp_path / "page.html")
    tab, complaints = fresh_tab(chromium, tmp_path / "page.html")
    assert tab.locator("#map-opens").is_hidden()
    assert tab.locator("#explorer").is_hidden()
    tab.locator("#map-grid path.s").first.dispatch_event("click")
    assert "my_model" in tab.inner_text("#summary")
    assert tab.evaluate("getComputedStyle(document.querySelector('#map-grid path.s')).cursor") != "pointer"
    tab.evaluate("location.hash = '#scene=bathroom'")
    assert complaints == []
    tab.close()


HOSTILE = '"><img src=x onerror="window.hacked=1"><b>%{x}</b>'


def test_names_are_text_never_markup(chromium: Any, runs: list[LoggedRun], tmp_path: Path):
    """A model's name may hold anything; what a page's rule did not list by its hash would not run, either."""
    hostile = [dataclasses.replace(run, label=HOSTILE) for run in runs[:2]]
    write_report(hostile, tmp_path / "page.html", Options(goals_per_scene=2, walks=1, max_steps=9))
    tab, complaints = fresh_tab(chromium, tmp_path / "page.html")
    assert tab.inner_text("#summary tbody tr:first-child td:first-child") == HOSTILE
    label = tab.get_attribute("#map-grid svg", "aria-label")
    assert label is not None
    assert label.startswith(HOSTILE)
    assert tab.locator("#map-grid img, #overview img, #curves img").count() == 0
    assert tab.evaluate("window.hacked") is None
    tab.evaluate(
        "document.body.append(Object.assign(document.createElement('script'), {text: 'hacked = 2'}))"
    )
    assert tab.evaluate("window.hacked") is None
    tab.evaluate(
        "document.body.append(Object.assign(document.createElement('style'), {textContent: '*{top:1px}'}))"
    )
    assert tab.evaluate("getComputedStyle(document.body).top") == "auto"
    assert all("Content Security Policy" in line for line in complaints)
    tab.close()
