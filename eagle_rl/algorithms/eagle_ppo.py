"""PPO as EAGLE uses it: one sum of all losses, one learning-rate step an iteration, true bootstraps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from eagle_rl.algorithms.acting import Acting
from eagle_rl.algorithms.gradient import KL, Gradient
from eagle_rl.algorithms.rollout import Rollout
from eagle_rl.algorithms.specialists import SpecialistBank
from eagle_rl.algorithms.stopwatch import Stopwatch
from eagle_rl.algorithms.terms import Distill, Estimation, Kickstart, Mirror, Ppo
from eagle_rl.algorithms.valuing import Valuing
from eagle_rl.config.schema import AlgoCfg
from eagle_rl.errors import HealthError
from eagle_rl.models import EagleActor
from eagle_rl.models.precision import keep_outputs_exact, multiplies_in_bfloat16

MAX_SKIPPED_STEPS = 3
"""Non-finite gradients in a row after which learning stops."""
MAX_KL_RATIO = 10.0
"""KL, as a multiple of ``desired_kl``, beyond which a minibatch takes no step [-] (ours)."""
LEARNING_RATE_FACTOR = 1.5
"""Change of the learning rate per iteration [-] (HugWBC 7)."""


class EaglePPO(PPO):
    """PPO with estimation and mirror losses and, given specialists, with distillation or Kickstarting."""

    actor: EagleActor
    storage: Rollout

    def __init__(
        self,
        actor: EagleActor,
        critic: MLPModel,
        storage: RolloutStorage,
        cfg: AlgoCfg,
        device: str = "cpu",
        multi_gpu_cfg: dict[str, int] | None = None,
        **unused: None,
    ) -> None:
        """Take over the models; ``unused`` are the extensions rsl_rl passes as None."""
        super().__init__(
            actor,
            critic,
            storage,
            gamma=cfg.gamma,
            lam=cfg.lam,
            learning_rate=cfg.learning_rate,
            use_mixed_precision=multiplies_in_bfloat16(cfg.precision, device),
            device=device,
            multi_gpu_cfg=multi_gpu_cfg,
        )
        for model in (actor, critic):
            keep_outputs_exact(model)
        critic.requires_grad_(cfg.use_ppo_loss)  # imitation alone has nothing to teach it
        self.cfg = cfg
        self.specialists: SpecialistBank | None = None
        self.robot_names: list[str] = []
        self.num_updates = 0
        self.imitation_updates = math.inf
        """Updates over which imitation without PPO lowers its learning rate; for ever, unless told."""
        self.compile_from = math.inf
        """Updates after which actions and gradients are computed by compiled kernels, equal up to rounding."""
        self.skipped_steps = 0
        self._skipped_in_a_row = 0
        self._withheld_steps = 0
        self.stopwatch = Stopwatch()
        self.gradient = Gradient(actor, critic, self.use_mixed_precision)
        self.acting = Acting(actor, self.use_mixed_precision)
        self.valuing = Valuing(critic, self.use_mixed_precision)
        if cfg.use_ppo_loss:
            self.gradient.terms.append(Ppo(critic, cfg))
        groups = [
            {"params": list(actor.parameters()), "lr": cfg.learning_rate},
            {"params": list(critic.parameters()), "lr": cfg.critic_learning_rate},
        ]
        self.optimizer = torch.optim.Adam(groups, fused=True)

    @staticmethod
    def construct_algorithm(obs: TensorDict, env: VecEnv, cfg: dict[str, Any], device: str) -> EaglePPO:
        """Build models, storage and algorithm for an environment with ``robot_names`` and a ``mirror`` map."""
        symmetric = cfg["algorithm"]["cfg"].network.symmetric
        actor = cfg["actor"] | {"mirror": env.mirror if symmetric else None}
        alg: EaglePPO = PPO.construct_algorithm(obs, env, cfg | {"actor": actor}, device)
        alg.storage = Rollout("rl", env.num_envs, cfg["num_steps_per_env"], obs, [env.num_actions], device)
        alg.robot_names = list(env.robot_names)
        algo, terms = alg.cfg, alg.gradient.terms
        if algo.estimation_coef > 0:
            terms.append(Estimation(algo.estimation_coef))
        if algo.mirror_coef > 0 and not symmetric:
            terms.append(Mirror(algo.mirror_coef, algo.mirror_fraction, env.mirror, device))
        return alg

    def imitate(self, specialists: SpecialistBank, method: Literal["eagle", "kickstart"]) -> None:
        """From now on learn from ``specialists`` too."""
        self.specialists = specialists
        cfg = self.cfg
        if method == "eagle":
            in_noise_units = cfg.action_loss_unit == "noise"
            self.gradient.terms.append(
                Distill(cfg.action_loss_coef, cfg.embedding_loss_coef, self.robot_names, in_noise_units)
            )
        else:
            self.gradient.terms.append(Kickstart(cfg.kickstart_coef, cfg.kickstart_decay))

    def act(self, obs: TensorDict) -> Tensor:
        """Sample actions, shape (N, 32), and keep what the update wants to know of them."""
        if self.num_updates >= self.compile_from:  # here, since a resumed run begins by acting
            self.acting.compile()
            self.valuing.compile()
            self.gradient.compile()
        decision, step = self.acting(obs), self.transition
        step.hidden_states, step.observations = (None, None), obs
        step.actions, step.actions_log_prob = decision.actions, decision.log_prob
        step.values = self.storage.values[0]  # not yet known: see compute_returns
        step.distribution_params = (decision.mean, decision.std)
        return decision.actions

    def process_env_step(self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: Mapping[str, Any]) -> None:
        """Record one step; where the environment cuts returns, the value of the true final observation goes on."""
        ids = extras["final_ids"].to(self.device)
        if len(ids):
            self.storage.cuts.append((self.storage.step, ids, extras["final_observations"].to(self.device)))
            dones = dones.index_fill(0, ids, 1)
        super().process_env_step(obs, rewards, dones, {})

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute values, returns and advantages; those of all processes are normalized together."""
        self.valuing.value(self.storage, self.gamma)
        super().compute_returns(obs)
        if self.gpu_world_size > 1:
            self._normalize_over_processes()

    def update(self) -> dict[str, float]:
        """Label the rollout, optimise the sum of all losses, adapt the learning rate; return scalars by tag."""
        if self.specialists is not None:
            self.storage.observations.update(self.specialists.label(self.storage.observations))
        told, kls = self._learn()
        self.storage.clear()
        self.num_updates += 1
        kl = sum(kls[-self.cfg.num_mini_batches :]) / self.cfg.num_mini_batches
        if self.cfg.use_ppo_loss:
            self._adapt_learning_rate(kl)
        else:  # imitation alone has no trust region to stay in
            self._anneal_learning_rate()
        withheld, self._withheld_steps = self._withheld_steps, 0
        counts = {"Health/skipped_updates": self.skipped_steps, "Loss/withheld_steps": withheld}
        return told | {KL: kl} | {tag: float(count) for tag, count in counts.items()}

    def _learn(self) -> tuple[dict[str, float], list[float]]:
        """Take a step for each minibatch of each epoch; return mean losses by tag and the KL of each minibatch."""
        cfg, gradient, kls = self.cfg, self.gradient, []
        sums = torch.zeros((), device=self.device)
        rows = self.storage.num_envs * self.storage.num_transitions_per_env // cfg.num_mini_batches
        batches = self.storage.minibatches(
            cfg.num_mini_batches,
            cfg.num_learning_epochs,
            gradient.num_shares(rows),
            gradient.prepare,
            num_updates=torch.tensor(float(self.num_updates), device=self.device),
        )
        for shares in batches:
            losses = gradient(shares)
            self.stopwatch.lap("gradient")
            total, weight = losses[gradient.tags.index(KL)]
            kls.append(self._mean_over_processes(total / weight))
            self._step(kls[-1])
            sums = sums + losses
            self.stopwatch.lap("optimiser")
        entries = zip(gradient.tags, sums.tolist(), strict=True)
        return {tag: total / weight for tag, (total, weight) in entries if weight > 0}, kls

    def _step(self, kl: float) -> None:
        """Step along the gradient averaged over processes, unless that does harm.

        It does where the gradient is not finite, and where the policy has already left the region PPO's loss is good
        for: one more step may wreck it.
        """
        if self.gpu_world_size > 1:
            self.reduce_parameters()
        if self.cfg.use_ppo_loss and kl > MAX_KL_RATIO * self.cfg.desired_kl:
            self._withheld_steps += 1
            return
        if all(map(math.isfinite, self.gradient.clip(self.cfg.max_grad_norm))):
            self._skipped_in_a_row = 0
            self.optimizer.step()
            self.actor.distribution.project_std()
            return
        self.skipped_steps += 1
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row == MAX_SKIPPED_STEPS:
            raise HealthError(
                f"The gradient was not finite {MAX_SKIPPED_STEPS} times in a row (update {self.num_updates}). "
                "The parameters are those before. Look at Loss/* and at the rewards of the last iterations; "
                "a smaller algo.learning_rate or algo.max_grad_norm often helps."
            )

    def save(self) -> dict[str, Any]:
        """Models, optimiser and counters, for :meth:`load`."""
        counters = {"num_updates": self.num_updates, "skipped_steps": self.skipped_steps}
        return super().save() | {"learning_rate": self.learning_rate, "counters": counters}

    def load(self, loaded_dict: dict[str, Any], load_cfg: dict[str, bool] | None = None, strict: bool = True) -> bool:
        """Restore what :meth:`save` returned, or the models named in ``load_cfg``."""
        iteration = super().load(loaded_dict, load_cfg, strict)
        if load_cfg is None:
            self.learning_rate = loaded_dict["learning_rate"]
            self.num_updates = loaded_dict["counters"]["num_updates"]
            self.skipped_steps = loaded_dict["counters"]["skipped_steps"]
        self.optimizer.param_groups[1]["lr"] = self.cfg.critic_learning_rate
        return iteration

    def adopt(self, learner: dict[str, Any]) -> None:
        """Take over critic and learning rate of what :meth:`save` returned, of a policy that acted alike.

        With a fresh critic, at the first learning rate, a residual falls before it has learned anything.
        """
        self.critic.load_state_dict(learner["critic_state_dict"])
        self.learning_rate = self.optimizer.param_groups[0]["lr"] = learner["learning_rate"]

    def _adapt_learning_rate(self, kl: float) -> None:
        """Lower the actor's learning rate where the last epoch moved the policy too far, raise it where too little."""
        low, high = self.cfg.learning_rate_range
        if kl > 2 * self.cfg.desired_kl:
            self.learning_rate = max(low, self.learning_rate / LEARNING_RATE_FACTOR)
        elif 0 < kl < self.cfg.desired_kl / 2:
            self.learning_rate = min(high, self.learning_rate * LEARNING_RATE_FACTOR)
        self.optimizer.param_groups[0]["lr"] = self.learning_rate

    def _anneal_learning_rate(self) -> None:
        """Lower the actor's learning rate by a constant factor an update, to the least of its range at the last."""
        first, last = self.cfg.learning_rate, self.cfg.learning_rate_range[0]
        self.learning_rate = first * (last / first) ** min(1.0, self.num_updates / self.imitation_updates)
        self.optimizer.param_groups[0]["lr"] = self.learning_rate

    def _normalize_over_processes(self) -> None:
        """Give the advantages of all processes together zero mean and unit variance, as one process would."""
        advantages = self.storage.returns - self.storage.values
        moments = advantages.new_tensor([advantages.numel(), 0.0, 0.0], dtype=torch.float64)
        moments[1], moments[2] = advantages.double().sum(), advantages.double().square().sum()
        torch.distributed.all_reduce(moments)
        count, total, squares = moments.tolist()
        variance = (squares - total**2 / count) / (count - 1)
        self.storage.advantages = (advantages - total / count) / (math.sqrt(variance) + 1e-8)

    def _mean_over_processes(self, value: Tensor) -> float:
        if self.gpu_world_size > 1:
            torch.distributed.all_reduce(value)
            value = value / self.gpu_world_size
        return value.item()
