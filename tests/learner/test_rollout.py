from __future__ import annotations

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from eagle_rl.algorithms.rollout import Rollout

ENVS, STEPS = 6, 5


def filled(kind: type[RolloutStorage]) -> RolloutStorage:
    generator = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    obs = TensorDict({"a": draw(ENVS, 3), "robot": torch.arange(ENVS)}, batch_size=[ENVS])
    storage = kind("rl", ENVS, STEPS, obs, [2])
    for _ in range(STEPS):
        step = RolloutStorage.Transition()
        step.observations = TensorDict({"a": draw(ENVS, 3), "robot": torch.arange(ENVS)}, batch_size=[ENVS])
        step.actions, step.rewards, step.dones = draw(ENVS, 2), draw(ENVS), torch.zeros(ENVS)
        step.values, step.actions_log_prob = draw(ENVS, 1), draw(ENVS)
        step.distribution_params = (draw(ENVS, 2), draw(ENVS, 2))
        storage.add_transition(step)
    storage.returns, storage.advantages = draw(STEPS, ENVS, 1), draw(STEPS, ENVS, 1)
    return storage


def flat(batch: RolloutStorage.Batch) -> dict[str, torch.Tensor]:
    values = {name: x for name, x in vars(batch).items() if isinstance(x, torch.Tensor)}
    old = dict(zip(("mean", "std"), batch.old_distribution_params, strict=True))
    return values | old | {f"obs {name}": x for name, x in batch.observations.items()}


def test_minibatches_are_those_of_rsl_rl():
    """Also where the transitions cannot be shared out evenly: the same rows are left out."""
    made = []
    for kind in (RolloutStorage, Rollout):
        torch.manual_seed(3)
        made.append([flat(batch) for batch in filled(kind).mini_batch_generator(4, 2)])
    assert len(made[0]) == len(made[1]) == 8
    for number, (theirs, ours) in enumerate(zip(*made, strict=True)):
        assert theirs.keys() == ours.keys()
        for name, value in theirs.items():
            assert torch.equal(value, ours[name]), f"{name} of minibatch {number}"
