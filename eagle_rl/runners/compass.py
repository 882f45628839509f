"""COMPASS, the paper's cross-embodiment baseline, out of the parts there are: its stages differ in who acts.

1. *Base*: rollouts of the demonstrator are imitated by a policy whose estimator also predicts the next proprioceptive
   frame from e(s_t), so that the policy head reads the prediction of a world model.
2. *Residual specialists*: PPO on each robot, its actions added to those of the frozen base.
3. *Distillation*: rollouts of base plus residual are imitated, by KL, by one policy that starts from the base.

``docs/decisions.md`` says what had to be adapted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor, nn

from eagle_rl.algorithms.specialists import SpecialistBank
from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ACTOR_INPUTS

Outcome = tuple[TensorDict, Tensor, Tensor, dict[str, Any]]


def mean_actions(actor: EagleActor, obs: TensorDict) -> Tensor:
    """Mean actions of a policy, shape (..., 32); leaves no trace in the actor."""
    history, command, clock = (obs[group] for group in ACTOR_INPUTS)
    return actor.mean_actions(history, command, clock, obs["slot_mask"])


def begin_residual(actor: EagleActor, base: EagleActor) -> None:
    """Let a fresh actor add nothing yet and explore as much as the base does."""
    output = [module for module in actor.mlp.modules() if isinstance(module, nn.Linear)][-1]
    nn.init.zeros_(output.weight)
    nn.init.zeros_(output.bias)
    with torch.no_grad():
        actor.distribution.std_param.copy_(base.distribution.std_param)


class ResidualPolicy:
    """The deterministic policy of base and residual together."""

    def __init__(self, base: EagleActor, residual: EagleActor) -> None:
        """Add ``residual`` to ``base``."""
        self.base, self.residual = base, residual

    def __call__(self, obs: TensorDict) -> Tensor:
        """Mean actions, shape (N, 32)."""
        return mean_actions(self.base, obs) + mean_actions(self.residual, obs)


class ResidualBank(SpecialistBank):
    """Specialists whose actions are those of a common base plus their own."""

    def __init__(self, base: EagleActor, residuals: Sequence[EagleActor]) -> None:
        """Freeze base and residuals."""
        super().__init__(residuals)
        self.base = base.eval().requires_grad_(False)

    def _label_rows(self, obs: TensorDict) -> dict[str, Tensor]:
        labels = super()._label_rows(obs)
        return labels | {"teacher_action": labels["teacher_action"] + mean_actions(self.base, obs)}


class _Wrapper(VecEnv):
    """An environment seen through another one."""

    def __init__(self, env: VecEnv) -> None:
        self.env = env

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def __setattr__(self, name: str, value: Any) -> None:
        """Set what the environment has there, where the learner means it: age of episodes, pooling, fault folder."""
        if name == "env" or not hasattr(self.env, name):
            super().__setattr__(name, value)
        else:
            setattr(self.env, name, value)


class ResidualEnv(_Wrapper):
    """Adds the actions of a frozen base to those it is given."""

    def __init__(self, env: VecEnv, base: EagleActor) -> None:
        """Let ``base`` act in ``env``."""
        super().__init__(env)
        self.base = base.eval().requires_grad_(False)

    def get_observations(self) -> TensorDict:
        """Those of the environment."""
        return self.env.get_observations()

    @torch.no_grad()
    def step(self, actions: Tensor) -> Outcome:
        """Step with base plus residual."""
        return self.env.step(mean_actions(self.base, self.env.get_observations()) + actions)


class DemonstrationEnv(_Wrapper):
    """Shows what happens when the specialists act, whatever actions it is given.

    It is one step ahead of what it shows, so that the group ``estimate`` can carry the next frame: what a world model
    is to predict. The last frame of an episode stands for its own successor.
    """

    def __init__(self, env: VecEnv, bank: SpecialistBank, frame_dim: int) -> None:
        """Let ``bank`` act in ``env``, whose frames are ``frame_dim`` numbers; 0 for no world model."""
        super().__init__(env)
        self.bank, self.frame_dim = bank, frame_dim
        self._obs = env.get_observations()
        self._outcome = self._demonstrate()

    def get_observations(self) -> TensorDict:
        """Observations of the present step, with the next frame to be predicted."""
        obs: TensorDict = self._obs.copy()
        frame = obs["history"][:, : self.frame_dim]
        following, _, dones, _ = self._outcome
        target = torch.where(dones.bool().unsqueeze(1), frame, following["history"][:, : self.frame_dim])
        obs["estimate"] = torch.cat([obs["estimate"], target], dim=1)
        return obs

    def step(self, actions: Tensor) -> Outcome:
        """Show the next step of the demonstration."""
        self._obs, rewards, dones, extras = self._outcome
        self._outcome = self._demonstrate()
        return self.get_observations(), rewards, dones, extras

    @torch.no_grad()
    def _demonstrate(self) -> Outcome:
        """The environment's next step under the specialists' own, stochastic actions."""
        labels = self.bank.label(self._obs.unsqueeze(0))
        mean, std = labels["teacher_action"][0], labels["teacher_std"][0]
        return self.env.step(mean + std * torch.randn_like(mean))

    def state_dict(self) -> dict[str, Any]:
        """The environment's state, and the step it is ahead."""
        following, rewards, dones, extras = self._outcome
        final = torch.zeros_like(dones, dtype=torch.bool)  # a row for every environment: a state has one shape
        final[extras["final_ids"]] = True
        final_observations = following.clone().zero_()
        final_observations[extras["final_ids"]] = extras["final_observations"]
        return {
            "env": self.env.state_dict(),
            "obs": self._obs.to_dict(),
            "following": following.to_dict(),
            "rewards": rewards,
            "dones": dones,
            "time_outs": extras["time_outs"],
            "final": final,
            "final_observations": final_observations.to_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.env.load_state_dict(state["env"])

        def observations(name: str, size: int) -> TensorDict:
            return TensorDict(state[name], batch_size=[size], device=self._obs.device)

        self._obs = observations("obs", self.env.num_envs)
        ids = state["final"].nonzero().squeeze(1)
        extras = {
            "time_outs": state["time_outs"],
            "final_ids": ids,
            "final_observations": observations("final_observations", self.env.num_envs)[ids],
            "log": {},
        }
        self._outcome = (observations("following", self.env.num_envs), state["rewards"], state["dones"], extras)
