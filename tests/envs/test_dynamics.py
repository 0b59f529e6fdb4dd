"""One step, by hand."""

from __future__ import annotations

import pytest
import torch

from vusfa.envs.dynamics import Rewards, push_frame, start_history, step

# Three places in a row; action 0 goes right, 1 goes left. State 1 has a mirror: its action 2 leads back to
# itself.
SUCCESSOR = torch.tensor([[1, 0, 0], [2, 0, 1], [2, 1, 2]])
BLOCKED = torch.tensor([[False, True, True], [False, False, False], [True, False, True]])


def walk(
    state: int, goal: int, action: int, clock: int = 0, rewards: Rewards | None = None, max_steps: int = 9
):
    return step(
        SUCCESSOR,
        BLOCKED,
        rewards or Rewards.of(),
        max_steps,
        state_id=torch.tensor([state, state]),
        goal_id=torch.tensor(goal),
        elapsed_steps=torch.tensor([clock]),
        action=torch.tensor(action),
    )


def test_a_move_pushes_a_frame_and_costs_a_little() -> None:
    after = walk(0, goal=2, action=0)
    assert after.state_id.tolist() == [0, 1]
    assert after.reward.tolist() == [pytest.approx(-0.01)]
    assert after.elapsed_steps.tolist() == [1]
    assert [x.item() for x in (after.collided, after.terminated, after.truncated, after.done)] == [False] * 4


def test_a_blocked_move_stays_and_pushes_a_frame_all_the_same() -> None:
    after = walk(2, goal=0, action=0)
    assert after.state_id.tolist() == [2, 2]
    assert after.collided.item() is True
    assert after.elapsed_steps.item() == 1
    assert after.reward.item() == pytest.approx(-0.01)


def test_a_loop_in_the_graph_is_not_a_collision() -> None:
    assert walk(1, goal=0, action=2).collided.item() is False


def test_the_goal_ends_the_episode_with_its_reward() -> None:
    after = walk(1, goal=2, action=0)
    assert (after.reward.item(), after.terminated.item(), after.truncated.item(), after.done.item()) == (
        1.0,
        True,
        False,
        True,
    )


def test_the_time_is_up_after_max_steps_and_not_before() -> None:
    early, late = walk(0, goal=2, action=0, clock=7), walk(0, goal=2, action=0, clock=8)
    assert (early.truncated.item(), early.done.item()) == (False, False)
    assert (late.truncated.item(), late.terminated.item(), late.done.item()) == (True, False, True)


def test_the_goal_with_the_last_step_is_both() -> None:
    after = walk(1, goal=2, action=0, clock=8)
    assert (after.terminated.item(), after.truncated.item()) == (True, True)
    assert after.reward.item() == 1.0


def test_the_papers_raw_rewards() -> None:
    raw = Rewards.of(goal=10.0, step=-0.01, collision=-0.1)
    assert walk(1, goal=2, action=0, rewards=raw).reward.item() == 10.0
    assert walk(1, goal=2, action=1, rewards=raw).reward.item() == pytest.approx(-0.01)
    assert walk(0, goal=2, action=1, rewards=raw).reward.item() == pytest.approx(-0.1)


def test_rewards_are_float32_whatever_the_default_type() -> None:
    torch.set_default_dtype(torch.float64)
    try:
        assert walk(0, goal=2, action=0).reward.dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("action", [3, 7])
def test_an_action_that_does_not_exist_is_an_error(action: int) -> None:
    with pytest.raises(IndexError):
        walk(0, goal=2, action=action)


def test_nothing_is_written_in_place() -> None:
    before = {
        "state_id": torch.tensor([[0, 1]]),
        "goal_id": torch.tensor([2]),
        "elapsed_steps": torch.tensor([[3]]),
        "action": torch.tensor([0]),
    }
    copies = {key: value.clone() for key, value in before.items()}
    step(SUCCESSOR, BLOCKED, Rewards.of(), 9, **before)
    for key, value in before.items():
        assert torch.equal(value, copies[key])


def test_a_history_begins_with_the_first_frame_repeated() -> None:
    history = start_history(torch.tensor([[3, 4]]), 3)
    assert history.tolist() == [[[3, 3, 3], [4, 4, 4]]]
    history[0, 0, 0] = 9  # its own memory: no other frame changes with it
    assert history.tolist() == [[[9, 3, 3], [4, 4, 4]]]


def test_a_history_of_one_is_the_present() -> None:
    assert push_frame(torch.tensor([[5]]), torch.tensor([6])).tolist() == [[6]]
