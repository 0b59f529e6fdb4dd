"""The environment against a plain-Python transcription of the task, over random graphs."""

from __future__ import annotations

from typing import Any

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import step_mdp

from vusfa.envs import TargetNavEnv
from vusfa.scenes import Scene, SceneSet


class Agent:
    """One row, told in plain Python: lists, loops and ifs."""

    def __init__(self, task: Task, frames: list[int], goal: int) -> None:
        self.task = task
        self.begin(frames, goal)

    def begin(self, frames: list[int], goal: int) -> None:
        assert len(frames) == self.task.history
        assert frames == [frames[0]] * len(frames), "the first frame is repeated"
        shortest = self.task.shortest(frames[0], goal)
        assert shortest is not None, "the goal can be reached from where the episode begins"
        assert shortest > 0, "the episode does not begin at the goal"
        self.frames, self.goal, self.shortest, self.clock = frames, goal, shortest, 0
        self.collided = self.terminated = self.truncated = False
        self.reward: float | None = None

    def step(self, action: int) -> None:
        here = self.frames[-1]
        target = self.task.moves[here][action]
        self.collided = target is None
        there = here if target is None else target
        self.frames = [*self.frames[1:], there]
        self.clock += 1
        self.terminated = there == self.goal
        self.truncated = self.clock >= self.task.max_steps
        if self.terminated:
            self.reward = self.task.rewards[0]
        elif self.collided and self.task.rewards[2] is not None:
            self.reward = self.task.rewards[2]
        else:
            self.reward = self.task.rewards[1]

    def told(self) -> dict[str, Any]:
        return {
            "state_id": self.frames,
            "goal_id": self.goal,
            "scene_id": self.task.scene_of[self.goal],
            "collided": [self.collided],
            "shortest_path": [self.shortest],
            "elapsed_steps": [self.clock],
            "terminated": [self.terminated],
            "truncated": [self.truncated],
            "done": [self.terminated or self.truncated],
        }


class Task:
    """The world in plain Python; states are numbered through over the scenes."""

    def __init__(
        self,
        graphs: list[list[list[int]]],
        history: int,
        max_steps: int,
        rewards: tuple[float, float, float | None],
    ) -> None:
        self.history, self.max_steps, self.rewards = history, max_steps, rewards
        self.moves: list[list[int | None]] = []
        self.scene_of: list[int] = []
        for index, graph in enumerate(graphs):
            first = len(self.moves)
            self.moves += [[None if t < 0 else first + t for t in row] for row in graph]
            self.scene_of += [index] * len(graph)

    def shortest(self, start: int, goal: int) -> int | None:
        reached, edge, count = {start}, {start}, 0
        while edge:
            if goal in edge:
                return count
            edge = {t for s in edge for t in self.moves[s] if t is not None} - reached
            reached |= edge
            count += 1
        return None

    def possible_goals(self) -> list[int]:
        states = range(len(self.moves))
        return [g for g in states if any(s != g and self.shortest(s, g) is not None for s in states)]


@st.composite
def worlds(draw: st.DrawFn) -> tuple[list[list[list[int]]], int]:
    actions = draw(st.integers(1, 4))
    graphs = []
    for _ in range(draw(st.integers(1, 3))):
        size = draw(st.integers(2, 7))
        row = st.lists(st.integers(-1, size - 1), min_size=actions, max_size=actions)
        graphs.append(draw(st.lists(row, min_size=size, max_size=size)))
    return graphs, actions


def build(graphs: list[list[list[int]]]) -> SceneSet:
    return SceneSet(
        Scene(f"scene {i}", torch.tensor(g), torch.rand(len(g), 1, 2)) for i, g in enumerate(graphs)
    )


def check(data: Any, agents: list[Agent]) -> None:
    flat = data.reshape(-1)
    assert len(agents) == len(flat)
    for key in agents[0].told():
        assert flat[key].tolist() == [agent.told()[key] for agent in agents], key
    if "reward" in flat.keys():
        torch.testing.assert_close(flat["reward"][:, 0], torch.tensor([agent.reward for agent in agents]))


def check_begun(
    data: Any, agents: list[Agent], rows: list[int], task: Task, dealt: list[int] | None, goals: list[int]
) -> None:
    """Rows that began anew did so as they may; the agents are told where."""
    flat = data.reshape(-1)
    for row in rows:
        goal = int(flat["goal_id"][row])
        assert goal in goals
        assert dealt is None or goal == dealt[row]
        agents[row].begin(flat["state_id"][row].tolist(), goal)


@settings(max_examples=70)
@given(st.data())
def test_every_step_reset_mask_time_out_and_collision(data: st.DataObject) -> None:
    graphs, actions = data.draw(worlds())
    history, max_steps = data.draw(st.integers(1, 5)), data.draw(st.integers(1, 6))
    rewards = data.draw(st.sampled_from([(1.0, -0.01, None), (10.0, -0.01, -0.1), (0.0, 0.5, -2.0)]))
    task = Task(graphs, history, max_steps, rewards)
    possible = task.possible_goals()
    if not possible:
        return
    goals = data.draw(st.lists(st.sampled_from(possible), min_size=1, max_size=4))
    batch = data.draw(st.sampled_from([(), (1,), (5,), (2, 3)]))
    sampling = data.draw(st.sampled_from(["fixed", "episode"]))
    count = torch.Size(batch).numel()
    dealt = [goals[row % len(goals)] for row in range(count)] if sampling == "fixed" else None

    env: EnvBase = TargetNavEnv(
        build(graphs),
        goals,
        batch,
        history=history,
        max_steps=max_steps,
        goal_sampling=sampling,
        goal_reward=rewards[0],
        step_reward=rewards[1],
        collision_reward=rewards[2],
        seed=data.draw(st.integers(0, 2**32)),
        shortest_path=True,
    )
    if data.draw(st.booleans(), label="transformed"):
        env = TransformedEnv(env)

    now = env.reset()
    agents = [Agent.__new__(Agent) for _ in range(count)]
    for agent in agents:
        agent.task = task
    check_begun(now, agents, list(range(count)), task, dealt, goals)
    check(now, agents)

    for _ in range(data.draw(st.integers(1, 12))):
        chosen = data.draw(st.lists(st.integers(0, actions - 1), min_size=count, max_size=count))
        now["action"] = torch.tensor(chosen).reshape(batch)
        for agent, action in zip(agents, chosen, strict=True):
            agent.step(action)
        how = data.draw(st.sampled_from(["both at once", "one by one", "reset where I say"]))
        if how == "both at once":
            taken, now = env.step_and_maybe_reset(now)
            check(taken["next"], agents)
        else:
            taken = env.step(now)
            check(taken["next"], agents)
            now = step_mdp(taken, exclude_action=False)
            check(now, agents)
        ended = [row for row, agent in enumerate(agents) if agent.terminated or agent.truncated]
        if how == "one by one":
            now = env.maybe_reset(now)
        if how == "reset where I say":
            more = data.draw(st.lists(st.integers(0, count - 1), max_size=count))
            ended = sorted({*ended, *more})
            if ended:
                mask = torch.zeros(count, 1, dtype=torch.bool)
                mask[ended] = True
                now["_reset"] = mask.reshape(*batch, 1)
                now = env.reset(now, set_state=False)
        check_begun(now, agents, ended, task, dealt, goals)
        check(now, agents)
