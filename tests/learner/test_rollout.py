from __future__ import annotations

import pytest
import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from eagle_rl.algorithms.rollout import Rollout

ENVS, STEPS = 6, 5


def filled(kind: type[RolloutStorage]) -> RolloutStorage:
    generator = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    mask = (draw(ENVS, 2) > 0.0).float()
    obs = TensorDict({"a": draw(ENVS, 3), "robot": torch.arange(ENVS), "slot_mask": mask}, batch_size=[ENVS])
    storage = kind("rl", ENVS, STEPS, obs, [2])
    for _ in range(STEPS):
        step = RolloutStorage.Transition()
        step.observations = obs.clone().update({"a": draw(ENVS, 3)})
        step.actions, step.rewards, step.dones = draw(ENVS, 2), draw(ENVS), torch.zeros(ENVS)
        step.values, step.actions_log_prob = draw(ENVS, 1), draw(ENVS)
        step.distribution_params = (draw(ENVS, 2), draw(ENVS, 2))
        storage.add_transition(step)
    storage.returns, storage.advantages = draw(STEPS, ENVS, 1), draw(STEPS, ENVS, 1)
    return storage


def flat(batch: RolloutStorage.Batch) -> dict[str, torch.Tensor]:
    columns = {"values", "returns", "advantages", "old_actions_log_prob"}
    numbers = {name.replace("actions_", ""): getattr(batch, name).squeeze(1) for name in columns}
    old = dict(zip(("old_mean", "old_std"), batch.old_distribution_params, strict=True))
    return {"actions": batch.actions} | numbers | old | dict(batch.observations.items())


@pytest.mark.parametrize("num_shares", [1, 2, 3])
def test_minibatches_are_those_of_rsl_rl_shared_out(num_shares):
    """Also where the transitions cannot be shared out evenly: the same rows are left out."""
    torch.manual_seed(3)
    theirs = [flat(batch) for batch in filled(RolloutStorage).mini_batch_generator(4, 2)]
    torch.manual_seed(3)
    ours = list(filled(Rollout).minibatches(4, 2, num_shares, age=torch.tensor(5.0)))
    assert len(theirs) == len(ours) == 8
    for number, (batch, shares) in enumerate(zip(theirs, ours, strict=True)):
        assert [share.index for share in shares] == list(range(num_shares))
        for share in shares:
            assert share.tensors.keys() == batch.keys() | {"live", "age"}
            assert (share.count, share.size, share["age"].item()) == (num_shares, len(batch["actions"]), 5.0)
            assert share["live"].item() == pytest.approx(batch["slot_mask"].sum().item() / share.size)
            for name, value in batch.items():
                assert torch.equal(share[name], value[share.index :: num_shares]), f"{name} of minibatch {number}"


@pytest.mark.parametrize("fraction", [0.01, 0.3, 0.5, 1.0])
def test_shares_agree_on_which_rows_lead(fraction):
    for shares in filled(Rollout).minibatches(2, 1, 2):
        rows = max(1, round(fraction * shares[0].size))
        found = [share.leading(fraction) for share in shares]
        assert [whole for _, whole in found] == [rows, rows]
        assert [own for own, _ in found] == [(rows + 1) // 2, rows // 2]
