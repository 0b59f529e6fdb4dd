"""A complete update in plain PyTorch: collect, returns, loss, backward, optimizer. One page, no library.

The same losses, targets, coefficients, optimizer and numbers of environments and steps as a
:class:`vusfa.training.Trainer`, whose weights it begins with; ``tests/benchmarks/test_bare_update.py``
compares loss terms and gradients with :class:`vusfa.objectives.USFLoss`. Weights stand still between
collecting and stepping, so the table of encoded states is computed once for both. It counts no episodes and
writes no log.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.peers.bare_env import BareEnv
from benchmarks.peers.bare_network import BareNetwork, Goals, Outputs, Rows, group
from vusfa.objectives import A3CRMSprop
from vusfa.training import Trainer
from vusfa.training.precision import resolve_autocast

__all__ = ["BareTraining", "Batch", "Noise", "Targets"]


class Batch(NamedTuple):
    """A rollout, time first.

    Attributes:
        state, goal, scene: (T, B, H), (T, B), (T, B) int64; goals as positions in the list of goals.
        action: (T, B) int64.
        after: (T, B, H) int64, where the step led.
        reward, terminated, done: (T, B).
    """

    state: Tensor
    goal: Tensor
    scene: Tensor
    action: Tensor
    after: Tensor
    reward: Tensor
    terminated: Tensor
    done: Tensor


class Noise(NamedTuple):
    """Of the goals' latents: (T * B, E) for the targets' values, (X, E) for the ends, (T * B, E) for the
    loss."""

    target: Tensor | None
    ends: Tensor | None
    loss: Tensor | None


class Targets(NamedTuple):
    """(R,) advantage and value, (R, E) successor features, in the order of the batch's rows."""

    advantage: Tensor
    value: Tensor
    successor: Tensor | None


class BareTraining:
    """A training by hand.

    Args:
        trainer: ours, whose settings, weights, goals and scenes are taken over. Adam or A3C's step for the
            whole batch, and lambda returns up to the rollout's end, are what it knows.
    """

    def __init__(self, trainer: Trainer) -> None:
        cfg = trainer.settings
        self.optim, self.objective, self.entropy = cfg["optim"], cfg["objective"], cfg["entropy"]
        env, threads = cfg["env"], trainer.algorithm.threads
        rows = cfg["collector"]["num_envs"] * cfg["collector"]["rollout"]
        if self.optim["kind"] not in ("adam", "a3c_rmsprop") or threads not in (
            None,
            cfg["collector"]["num_envs"],
        ):
            raise ValueError("BareTraining knows optim=adam, and optim=a3c with one step per batch")
        self.net = BareNetwork(
            trainer.agent,
            half=resolve_autocast(cfg["autocast"], cfg["device"]),
            few=2 * rows < trainer.scenes.num_states,
        )
        self.params = list(self.net.params.values())
        self.goal_ids = trainer.goals
        self.slot = torch.zeros(trainer.scenes.num_states, dtype=torch.int64)
        self.slot[self.goal_ids] = torch.arange(len(self.goal_ids))
        self.steps = cfg["collector"]["rollout"]
        self.env = BareEnv(
            trainer.scenes,
            self.goal_ids,
            cfg["collector"]["num_envs"],
            history=trainer.agent.config["history"],
            max_steps=env["max_steps"],
            sampling=env["goal_sampling"],
            goal_reward=env["goal_reward"],
            step_reward=env["step_reward"],
        )
        self.beta = torch.tensor(float(self.objective["bottleneck_coeff"]))
        self.threads = threads or 1
        options = {key: value for key, value in self.optim["options"].items() if key != "threads_per_update"}
        self.optimizer: torch.optim.Optimizer
        if threads is None:
            self.optimizer = torch.optim.Adam(self.params, lr=self.optim["lr"], **{"fused": True, **options})
        else:
            self.optimizer = A3CRMSprop(self.params, lr=self.optim["lr"], threads=threads, **options)
        self.frames = 0

    def collect(self) -> int:
        """Walk one rollout and throw it away; the frames it has."""
        with torch.no_grad():
            w = self.net.weights()
            self._walk(w, self.net.states(w), self.net.goals(w, self.goal_ids))
        return self.steps * self.env.rows

    @torch.no_grad()
    def _walk(self, w: dict[str, Tensor], states: Tensor, goals: Goals) -> Batch:
        env, taken = self.env, []
        for _ in range(self.steps):
            state, goal, scene = env.state, self.slot[env.goal], env.scene
            rows = group(state, goal, scene, self.net.num_scenes)
            logits = torch.empty(env.rows, env.num_actions)
            logits[rows.order] = self.net.rows(w, states, goals, rows, acting=True).logits
            # a draw from the softmax: the largest of logits with Gumbel noise
            action = (logits - torch.empty_like(logits).exponential_().log_()).argmax(-1)
            after = env.step(action)
            taken.append(
                (state, goal, scene, action, after.state, after.reward, after.terminated, after.done)
            )
        return Batch(*(torch.stack(column) for column in zip(*taken, strict=True)))

    def update(self) -> int:
        """One update; the frames that it took."""
        w = self.net.weights()
        states, goals = self.net.states(w), self.net.goals(w, self.goal_ids)
        batch = self._walk(w, states.detach(), _detached(goals))
        loss, kl = self.loss(w, states, goals, batch)
        for group_ in self.optimizer.param_groups:
            group_["lr"] = self._annealed(self.optim["lr"], 0.0, self.optim["horizon"])
        self.optimizer.zero_grad()
        loss.backward()
        if not isinstance(self.optimizer, A3CRMSprop):  # which clips by itself
            torch.nn.utils.clip_grad_norm_(self.params, self.optim["max_grad_norm"])
        self.optimizer.step()
        if kl is not None:
            step = self.threads * self.objective["bottleneck_step_size"]
            target = self.objective["information_target"]
            self.beta = (self.beta + step * (kl.detach() - target)).clamp(min=0.0)
        self.frames += batch.reward.numel()
        return batch.reward.numel()

    def loss(
        self, w: dict[str, Tensor], states: Tensor, goals: Goals, batch: Batch, noise: Noise | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """The sum of the weighted terms, and the latents' KL."""
        rows = group(
            batch.state.flatten(0, 1), batch.goal.flatten(), batch.scene.flatten(), self.net.num_scenes
        )
        out = self.net.rows(w, states, goals, rows)
        if noise is None:
            noise = self._draw(batch, out)
        target = self.targets(w, states, goals, batch, rows, out, noise)
        value = self.net.value(w, goals, rows, out, None if noise.loss is None else noise.loss[rows.order])
        log_prob = out.logits.log_softmax(-1)
        chosen = log_prob.gather(-1, batch.action.flatten()[rows.order].unsqueeze(-1)).squeeze(-1)
        entropy = -(log_prob.exp() * log_prob).sum(-1).mean()
        c = self.objective
        loss = -c["objective_coeff"] * (chosen * target.advantage[rows.order]).mean()
        loss = loss + c["critic_coeff"] * (target.value[rows.order] - value).square().mean()
        loss = loss - self._annealed(**self.entropy) * entropy
        kl = None
        if out.successor is not None:
            assert target.successor is not None
            error = (target.successor[rows.order] - out.successor).square().mean()
            loss = loss + c["successor_coeff"] * error
        if out.scale is not None:
            assert goals.scale is not None
            of_goals = _divergence(goals.loc, goals.scale)[rows.goal].mean()
            kl = of_goals
            if c["bottleneck_on"] == "both":
                kl = 0.5 * (_divergence(out.loc, out.scale).mean() + of_goals)
            loss = loss + self.beta * (kl - c["information_target"])
        return loss, kl

    @torch.no_grad()
    def targets(
        self,
        w: dict[str, Tensor],
        states: Tensor,
        goals: Goals,
        batch: Batch,
        rows: Rows,
        out: Outputs,
        noise: Noise,
    ) -> Targets:
        """Lambda returns of reward and embedding; time-outs and the rollout's end are bootstrapped."""
        time, envs = batch.reward.shape
        net, size = self.net, time * envs
        back = torch.empty_like(rows.order)
        back[rows.order] = torch.arange(size)
        sorted_noise = None if noise.target is None else noise.target[rows.order]
        value = net.value(w, goals, rows, out, sorted_noise)[back]
        # states that are no root of the batch: where an episode or the rollout ended
        outside = batch.done.clone()
        outside[-1] = True
        ends = outside.flatten().nonzero().squeeze(-1)
        end_rows = group(
            batch.after.flatten(0, 1)[ends],
            batch.goal.flatten()[ends],
            batch.scene.flatten()[ends],
            net.num_scenes,
        )
        end = net.rows(w, states, goals, end_rows)
        end_noise = None if noise.ends is None else noise.ends[end_rows.order]
        end_value = net.value(w, goals, end_rows, end, end_noise)
        place = ends[end_rows.order]
        following = torch.cat([value[envs:], value.new_zeros(envs)])
        following[place] = end_value
        cumulant, bootstrap = batch.reward.unsqueeze(-1), following.view(time, envs, 1)
        if out.successor is not None and end.successor is not None:
            psi = _following(out.successor, back, envs, place, end.successor)
            phi = _following(out.embedding, back, envs, place, end.embedding)
            cumulant = torch.cat([cumulant, phi.view(time, envs, -1)], -1)
            bootstrap = torch.cat([bootstrap, psi.view(time, envs, -1)], -1)
        returns = self._returns(cumulant, bootstrap, batch).flatten(0, 1)
        target = returns[:, 0]
        advantage = target - value
        if self.objective["normalize_advantage"]:
            deviation = advantage.std(correction=0).clamp_min(self.objective["min_advantage_std"])
            advantage = (advantage - advantage.mean()) / deviation
        return Targets(advantage, target, returns[:, 1:] if out.successor is not None else None)

    def _returns(self, cumulant: Tensor, bootstrap: Tensor, batch: Batch) -> Tensor:
        gamma, lmbda = self.objective["gamma"], self.objective["lmbda"]
        bootstrap = bootstrap.masked_fill(batch.terminated.unsqueeze(-1), 0.0)
        value, done = bootstrap[-1], batch.done.unsqueeze(-1)
        result = torch.empty_like(cumulant)
        for t in reversed(range(len(cumulant))):
            later = value if lmbda == 1.0 else bootstrap[t].lerp(value, lmbda)
            value = torch.add(
                cumulant[t], torch.where(done[t], bootstrap[t], later), alpha=gamma, out=result[t]
            )
        return result

    def _draw(self, batch: Batch, out: Outputs) -> Noise:
        if out.scale is None:
            return Noise(None, None, None)
        size, width = out.loc.shape
        ends = int(batch.done[:-1].sum()) + batch.done.shape[1]
        return Noise(torch.randn(size, width), torch.randn(ends, width), torch.randn(size, width))

    def _annealed(self, start: float, end: float, horizon: int | None) -> float:
        return start if horizon is None else start + (end - start) * min(1.0, self.frames / horizon)


def _following(sorted_rows: Tensor, back: Tensor, envs: int, place: Tensor, ends: Tensor) -> Tensor:
    """What stands a step later, (R, E): the next root's, or that of an end."""
    result = sorted_rows[torch.cat([back[envs:], back[:envs]])]
    result[place] = ends
    return result


def _divergence(loc: Tensor, scale: Tensor) -> Tensor:
    """KL of N(loc, scale^2) from N(0, 1), mean over features."""
    variance = scale.square()
    return 0.5 * (loc.square() + variance - (variance + 1e-8).log() - 1.0).mean(-1)


def _detached(goals: Goals) -> Goals:
    return Goals(*(None if x is None else x.detach() for x in goals))  # type: ignore[arg-type]
