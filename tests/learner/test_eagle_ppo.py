"""The update: what is summed, what is skipped, what the specialists say."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal, kl_divergence

from eagle_rl.algorithms import specialists as specialists_module
from eagle_rl.algorithms.specialists import SpecialistBank
from eagle_rl.errors import HealthError
from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ACTOR_INPUTS
from eagle_rl.runners.on_policy import EagleRunner
from tests.learner.helpers import collect, make_runner, parameters

ONE_STEP = {"num_learning_epochs": 1, "num_mini_batches": 1}


def shaken(actor: EagleActor, seed: int, scale: float = 0.1) -> EagleActor:
    """A copy with other weights."""
    twin = copy.deepcopy(actor)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in twin.parameters():
            p.add_(scale * torch.randn(p.shape, generator=generator))
    twin.distribution.project_std()
    return twin


def with_specialists(runner: EagleRunner, method: str = "eagle") -> list[EagleActor]:
    bank = [shaken(runner.alg.actor, seed) for seed in range(3)]
    runner.alg.imitate(SpecialistBank(bank), method)
    return bank


@torch.no_grad()
def distances(actor: EagleActor, bank: list[EagleActor], obs: TensorDict) -> list[float]:
    """L_a and L_e of each robot on given states."""
    found = []
    for robot, specialist in enumerate(bank):
        rows = obs[obs["robot"] == robot]
        action = (actor(rows) - specialist(rows)).square().sum() / rows["slot_mask"].sum()
        found += [action.item(), (actor.embedding - specialist.embedding).square().mean().item()]
    return found


def hand_written_loss(runner: EagleRunner, bank: list[EagleActor]) -> torch.Tensor:
    """Every term of the loss on the whole rollout, row by row over live slots, sharing no code with the learner."""
    alg, cfg, storage = runner.alg, runner.alg.cfg, runner.alg.storage
    obs = storage.observations.flatten(0, 1).exclude("teacher_action", "teacher_std", "teacher_embedding")
    actions, old_log_prob, advantages, returns = (
        x.flatten(0, 1).clone()
        for x in (storage.actions, storage.actions_log_prob, storage.advantages, storage.returns)
    )
    mean, std = alg.actor(obs), alg.actor.distribution.std_param
    embedding, estimate = alg.actor.embedding, alg.actor.estimate
    perm, sign = runner.env.mirror["actions"]
    flipped = {k: obs[k][:, runner.env.mirror[k][0]] * runner.env.mirror[k][1] for k in ("history", "command", "clock")}
    mirrored = obs.clone().update(flipped | {"slot_mask": obs["slot_mask"][:, perm]})
    image = alg.actor(mirrored)[:, perm] * sign

    surrogate, entropy, mirror, action, embed, kick = [], [], [], [], [], []
    for i in range(len(obs)):
        live = obs["slot_mask"][i] > 0
        pi = Normal(mean[i, live], std[live])
        ratio = torch.exp(pi.log_prob(actions[i, live]).sum() - old_log_prob[i, 0])
        clipped = ratio.clamp(1 - cfg.clip_param, 1 + cfg.clip_param)
        surrogate.append(-torch.min(advantages[i, 0] * ratio, advantages[i, 0] * clipped))
        entropy.append(pi.entropy().sum())
        mirror.append((mean[i, live].detach() - image[i, live]).square())
        teacher = bank[int(obs["robot"][i])]
        with torch.no_grad():
            teacher_mean = teacher(obs[i : i + 1])[0, live]
            teacher_std = teacher.distribution.std_param[live]
        unit = teacher_std if cfg.action_loss_unit == "noise" else 1.0
        action.append(((mean[i, live] - teacher_mean) / unit).square())
        embed.append((embedding[i] - teacher.embedding[0]).square())
        kick.append(kl_divergence(Normal(teacher_mean, teacher_std), pi).sum())
    error = (estimate - obs["estimate"]).square()
    return (
        torch.stack(surrogate).mean()
        + cfg.value_loss_coef * (alg.critic(obs) - returns).square().mean()
        - cfg.entropy_coef * torch.stack(entropy).mean()
        + cfg.estimation_coef * (error[:, :3].mean() + error[:, 3:].mean())
        + cfg.mirror_coef * torch.cat(mirror).mean()
        + cfg.action_loss_coef * torch.cat(action).mean()
        + cfg.embedding_loss_coef * torch.cat(embed).mean()
        + cfg.kickstart_coef * math.exp(-cfg.kickstart_decay * alg.num_updates) * torch.stack(kick).mean()
    )


@pytest.mark.parametrize("unit", ["action", "noise"])
def test_the_gradient_of_update_is_that_of_a_hand_written_sum_of_all_losses(unit):
    runner = make_runner(
        **ONE_STEP,
        mirror_fraction=1.0,
        max_grad_norm=1e9,
        learning_rate=0.0,
        entropy_coef=0.01,
        action_loss_coef=0.3,
        action_loss_unit=unit,
        desired_kl=1e3,
    )
    runner.env.mask[::3, 2] = 0.0  # a robot that is not its own mirror image
    bank = with_specialists(runner)
    with_specialists(runner, "kickstart")
    runner.alg.num_updates = 50
    collect(runner)
    runner.alg.actor.load_state_dict(shaken(runner.alg.actor, 9, 0.03).state_dict())  # so that ratios are not all 1
    hand_written_loss(runner, bank).backward()
    named = [(f"{m}.{k}", p) for m in ("actor", "critic") for k, p in getattr(runner.alg, m).named_parameters()]
    expected = {name: p.grad.clone() for name, p in named}
    runner.alg.update()
    for name, p in named:
        scale = expected[name].abs().max().item()
        torch.testing.assert_close(
            p.grad, expected[name], rtol=1e-3, atol=1e-4 * scale, msg=lambda m, n=name: f"{n}: {m}"
        )


def test_returns_are_cut_and_bootstrapped_with_the_value_of_their_true_final_observation():
    runner = make_runner()
    alg, env = runner.alg, runner.env
    obs = env.get_observations()
    final = obs[:2].clone()
    final["critic"] = torch.tensor([[5.0], [-3.0]]).expand(2, obs["critic"].shape[1]).clone()
    extras = {"final_ids": torch.tensor([4, 1]), "final_observations": final, "time_outs": torch.ones(env.num_envs)}
    with torch.no_grad():
        alg.act(obs)
        alg.process_env_step(obs, torch.full((env.num_envs,), 2.0), torch.zeros(env.num_envs).bool(), extras)
        for _ in range(2):  # what is added once is not added again
            alg.valuing.value(alg.storage, alg.gamma)
        values = alg.critic(final)[:, 0]
        torch.testing.assert_close(alg.storage.values[0], alg.critic(obs))
    expected = torch.full((env.num_envs,), 2.0)
    expected[4] += 0.9 * values[0]
    expected[1] += 0.9 * values[1]
    torch.testing.assert_close(alg.storage.rewards[0, :, 0], expected)
    assert alg.storage.dones[0, :, 0].nonzero().flatten().tolist() == [1, 4], "nothing flows back across the cut"
    assert abs(values[0] - values[1]) > 1e-3, "the critic cannot tell the two apart, so the test shows nothing"


def test_what_was_cut_in_a_rollout_that_is_thrown_away_is_not_added_to_the_next():
    alg = make_runner().alg
    alg.storage.cuts.append((0, torch.tensor([1]), alg.storage.observations[0][:1]))
    alg.storage.clear()
    alg.storage.rewards.zero_()
    alg.valuing.value(alg.storage, alg.gamma)
    assert not alg.storage.rewards.any()


@pytest.mark.parametrize(
    ("desired_kl", "learning_rate", "expected"),
    [(1e-9, 1e-3, 1e-3 / 1.5), (1e3, 1e-3, 1.5e-3), (1e-9, 1.2e-5, 1e-5), (1e3, 1.9e-3, 2e-3)],
)
def test_the_learning_rate_moves_once_an_iteration_inside_its_range(desired_kl, learning_rate, expected, monkeypatch):
    runner = make_runner(desired_kl=desired_kl, learning_rate=learning_rate)
    used, step = [], runner.alg._step
    rate = lambda: runner.alg.optimizer.param_groups[0]["lr"]  # noqa: E731
    monkeypatch.setattr(runner.alg, "_step", lambda kl: used.append(rate()) or step(kl))
    collect(runner)
    runner.alg.update()
    assert used == [learning_rate] * 16
    assert runner.alg.learning_rate == pytest.approx(expected)
    assert runner.alg.optimizer.param_groups[0]["lr"] == runner.alg.learning_rate


def test_a_policy_that_does_not_move_keeps_its_learning_rate():
    runner = make_runner(max_grad_norm=0.0)
    collect(runner)
    assert runner.alg.update()["Loss/kl"] == 0.0
    assert runner.alg.learning_rate == runner.alg.cfg.learning_rate


def test_the_learning_rate_follows_the_kl_of_the_last_epoch():
    runner = make_runner(num_learning_epochs=2, num_mini_batches=1)
    collect(runner)
    assert runner.alg.update()["Loss/kl"] > 0.0, "the KL of the first epoch, before any step, is zero"


def test_gradients_of_actor_and_critic_are_shortened_each_by_its_own_length():
    lengths = {}
    for bound in (1e9, 0.05):
        runner = make_runner(**ONE_STEP, max_grad_norm=bound, value_loss_coef=1e-4)
        collect(runner)
        runner.alg.update()
        models = (runner.alg.actor, runner.alg.critic)
        lengths[bound] = [torch.cat([p.grad.flatten() for p in m.parameters()]).norm().item() for m in models]
    assert lengths[1e9][0] > 0.05 > lengths[1e9][1], f"one is to be shortened and one is not: {lengths[1e9]}"
    assert lengths[0.05] == pytest.approx([0.05, lengths[1e9][1]], rel=1e-3)


def test_the_critic_s_learning_rate_is_its_own():
    runner = make_runner(critic_learning_rate=3e-4, desired_kl=1e-6)
    collect(runner)
    runner.alg.update()
    assert runner.alg.learning_rate < runner.alg.cfg.learning_rate, "the actor's follows the KL"
    assert [group["lr"] for group in runner.alg.optimizer.param_groups] == [runner.alg.learning_rate, 3e-4]


@pytest.mark.parametrize(("kl", "factor"), [(0.0, 1), (0.004, 1.5), (0.006, 1), (0.019, 1), (0.021, 1 / 1.5)])
def test_the_learning_rate_is_kept_while_the_kl_is_within_a_factor_of_two_of_its_target(kl, factor):
    alg = make_runner(desired_kl=0.01).alg
    alg._adapt_learning_rate(kl)
    assert alg.learning_rate == pytest.approx(alg.cfg.learning_rate * factor)


def test_the_mirror_loss_is_computed_on_its_share_of_a_minibatch_in_the_same_pass(monkeypatch):
    runner = make_runner(**ONE_STEP, mirror_fraction=0.25)
    collect(runner)
    rows, alg = [], runner.alg
    outputs = alg.actor.outputs
    monkeypatch.setattr(alg.actor, "outputs", lambda *x: rows.append(len(x[0])) or outputs(*x))
    (share,) = next(iter(alg.storage.minibatches(1, 1)))
    prepared = alg.gradient.prepare(share)
    alg.update()
    assert rows == [8 * 24 + 8 * 24 // 4]
    for group in ACTOR_INPUTS:
        perm, sign = runner.env.mirror[group]
        images = share[group][: 8 * 24 // 4, perm] * sign
        assert torch.equal(prepared[group], torch.cat((share[group], images))), f"images of the leading rows: {group}"


def test_the_learned_std_stays_inside_its_range():
    runner = make_runner(entropy_coef=10.0, learning_rate=1.0, learning_rate_range=(1.0, 1.0))
    collect(runner)
    runner.alg.update()
    std = runner.alg.actor.distribution.std_param
    assert std.max() == runner.alg.actor.distribution.std_range[1]


def test_a_policy_that_has_moved_too_far_takes_no_further_step():
    """One step of a huge learning rate is taken; the remaining three of the update would be too."""
    ends = []
    for epochs in (1, 4):
        runner = make_runner(num_learning_epochs=epochs, num_mini_batches=1, learning_rate=0.3)
        collect(runner)
        assert runner.alg.update()["Loss/withheld_steps"] == epochs - 1
        ends.append(parameters(runner))
    for key, x in ends[0].items():
        torch.testing.assert_close(ends[1][key], x, msg=key)


def test_imitation_alone_may_move_as_far_as_it_likes():
    runner = make_runner(num_learning_epochs=4, num_mini_batches=1, learning_rate=0.3, use_ppo_loss=False)
    collect(runner)
    assert runner.alg.update()["Loss/withheld_steps"] == 0.0


@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf, 1e30])
def test_a_step_whose_gradient_is_not_finite_is_skipped_and_counted(poison):
    runner = make_runner(**ONE_STEP)
    collect(runner)
    before = parameters(runner)
    runner.alg.storage.returns[0, 0] = poison
    scalars = runner.alg.update()
    assert scalars["Health/skipped_updates"] == 1.0
    assert all(torch.equal(x, before[key]) for key, x in parameters(runner).items())
    collect(runner)
    assert runner.alg.update()["Health/skipped_updates"] == 1.0
    assert not torch.equal(parameters(runner)["actor.mlp.0.weight"], before["actor.mlp.0.weight"])


def test_three_gradients_in_a_row_that_are_not_finite_stop_the_run():
    runner = make_runner(num_learning_epochs=3, num_mini_batches=1)
    collect(runner)
    before = parameters(runner)
    runner.alg.storage.returns[0, 0] = math.nan
    with pytest.raises(HealthError, match="3 times in a row"):
        runner.alg.update()
    assert all(torch.equal(x, before[key]) for key, x in parameters(runner).items())


def test_gradients_that_are_not_finite_now_and_then_do_not_stop_the_run():
    runner = make_runner(num_learning_epochs=4, num_mini_batches=4)
    collect(runner)
    runner.alg.storage.returns[0, 0] = math.nan
    assert runner.alg.update()["Health/skipped_updates"] == 4.0


def test_each_row_is_labelled_by_the_specialist_of_its_robot(monkeypatch):
    monkeypatch.setattr(specialists_module, "CHUNK_ROWS", 7)  # several chunks, the last one short
    runner = make_runner()
    bank = [shaken(runner.alg.actor, seed) for seed in range(3)]
    collect(runner)
    labels = SpecialistBank(bank).label(runner.alg.storage.observations)
    obs = runner.alg.storage.observations
    for robot, specialist in enumerate(bank):
        rows = obs["robot"] == robot
        with torch.no_grad():
            expected = specialist(obs[rows])
        torch.testing.assert_close(labels["teacher_action"][rows], expected)
        torch.testing.assert_close(labels["teacher_embedding"][rows], specialist.embedding)
        torch.testing.assert_close(
            labels["teacher_std"][rows], specialist.distribution.std_param * obs["slot_mask"][rows]
        )
    assert all(torch.count_nonzero(labels[k] * (1 - obs["slot_mask"])) == 0 for k in ("teacher_action", "teacher_std"))


def test_specialists_are_frozen():
    runner = make_runner()
    bank = with_specialists(runner)
    before = [copy.deepcopy(actor.state_dict()) for actor in bank]
    runner.learn(2)
    assert not any(p.requires_grad for actor in runner.alg.specialists.specialists for p in actor.parameters())
    for actor, state in zip(bank, before, strict=True):
        assert all(torch.equal(x, state[key]) for key, x in actor.state_dict().items())


@pytest.mark.parametrize("use_ppo_loss", [True, False])
def test_distillation_brings_actions_and_embeddings_of_every_robot_to_its_specialist(use_ppo_loss):
    rates = {"learning_rate": 3e-3, "learning_rate_range": (3e-3, 3e-3)}
    runner = make_runner(action_loss_coef=20.0, estimation_coef=0.5, use_ppo_loss=use_ppo_loss, **rates)
    bank = [shaken(runner.alg.actor, 0)] * 3
    runner.alg.imitate(SpecialistBank(bank), "eagle")
    collect(runner)
    states = runner.alg.storage.observations.flatten(0, 1).clone()
    before = distances(runner.alg.actor, bank, states)
    scalars = runner.alg.update()
    assert {f"Distill/{loss}/{name}" for loss in ("L_a", "L_e") for name in runner.alg.robot_names} <= set(scalars)
    for _ in range(20):
        collect(runner)
        runner.alg.update()
    after = distances(runner.alg.actor, bank, states)
    assert all(b < 0.6 * a for a, b in zip(before, after, strict=True)), f"{before} -> {after}"


def test_pure_imitation_lowers_its_learning_rate_to_the_least_however_far_the_policy_moves():
    runner = make_runner(use_ppo_loss=False, learning_rate=1e-3, learning_rate_range=(1e-5, 1.0), desired_kl=1e-6)
    with_specialists(runner)
    runner.alg.imitation_updates = 4
    rates = []
    for _ in range(5):
        collect(runner)
        scalars = runner.alg.update()
        rates.append(runner.alg.optimizer.param_groups[0]["lr"])
    assert scalars["Loss/kl"] > 1e-6, "the policy has to move for this test to mean anything"
    assert rates == pytest.approx([1e-3 * 10 ** (-step / 2) for step in (1, 2, 3, 4, 4)])


def test_pure_imitation_leaves_the_critic_and_the_exploration_alone():
    runner = make_runner(use_ppo_loss=False)
    with_specialists(runner)
    before = parameters(runner)
    collect(runner)
    runner.alg.update()
    for key, x in parameters(runner).items():
        still = key.startswith("critic") or key == "actor.distribution.std_param"
        assert torch.equal(x, before[key]) == still, key
    assert all(p.grad is None for p in runner.alg.critic.parameters()), "no time is spent on what it does not learn"


def test_kickstarting_fades_with_the_iterations_of_its_stage():
    runner = make_runner(kickstart_coef=2.0, kickstart_decay=0.1)
    with_specialists(runner, "kickstart")
    weight = runner.alg.gradient.terms[-1].weight
    assert weight(torch.tensor(0.0)) == 2.0
    assert weight(torch.tensor(5.0)).item() == pytest.approx(2.0 * math.exp(-0.5))


def test_losses_with_weight_zero_are_not_computed():
    runner = make_runner(estimation_coef=0.0, mirror_coef=0.0)
    collect(runner)
    assert not {"Loss/estimation", "Loss/mirror"} & set(runner.alg.update())
