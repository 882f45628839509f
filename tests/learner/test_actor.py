"""The policy as the rest of the project uses it."""

import copy
import dataclasses

import pytest
import torch
from tensordict import TensorDict

from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ACTOR_INPUTS
from tests.learner.helpers import NETWORK, make_runner
from tests.toy import FRAMES, ToyEnv


@pytest.fixture
def actor() -> EagleActor:
    return make_runner().alg.actor


@pytest.fixture
def obs() -> TensorDict:
    env = ToyEnv()
    for _ in range(4):
        env.step(torch.randn(env.num_envs, env.num_actions))
    return env.get_observations()


def test_the_policy_head_reads_embedding_estimate_newest_frame_command_and_clock(actor, obs):
    latent, embedding, estimate = actor.features(*(obs[group] for group in ACTOR_INPUTS))
    newest = obs["history"][:, : obs["history"].shape[1] // FRAMES]
    assert torch.equal(latent, torch.cat([embedding, estimate, newest, obs["command"], obs["clock"]], 1))
    assert torch.equal(embedding, actor.encoder(obs["history"]))
    assert torch.equal(estimate, actor.estimator(embedding))
    actor(obs)
    assert torch.equal(actor.embedding, embedding)
    assert torch.equal(actor.estimate, estimate)


def test_the_policy_gradient_reaches_estimator_and_encoder(actor, obs):
    actor(obs).square().sum().backward()
    for part in (actor.encoder, actor.estimator):
        assert all(p.grad.abs().sum() > 0 for p in part.parameters())


def test_a_copy_after_a_forward_pass_is_independent_and_equal(actor, obs):
    actor(obs, stochastic_output=True)
    twin = copy.deepcopy(actor)
    assert torch.equal(twin(obs), actor(obs))
    with torch.no_grad():
        twin.encoder[0].weight.zero_()
    assert not torch.equal(twin(obs), actor(obs))


def test_exported_policy_computes_what_the_actor_computes(actor, obs):
    exported = actor.as_onnx()
    actions, estimate, embedding = exported(*(obs[name] for name in exported.input_names))
    assert torch.equal(actions, actor(obs))
    assert torch.equal(estimate, actor.estimate)
    assert torch.equal(embedding, actor.embedding)
    assert [x.shape[1] for x in exported.get_dummy_inputs()] == [obs[n].shape[1] for n in exported.input_names]


def test_mean_actions_of_other_observations_leave_no_trace(actor, obs):
    actor(obs, stochastic_output=True)
    mean, embedding = actor.output_mean, actor.embedding
    actor.mean_actions(*(torch.randn_like(obs[name]) for name in ACTOR_INPUTS), 1 - obs["slot_mask"])
    assert actor.output_mean is mean
    assert actor.embedding is embedding
    assert actor.distribution.mask is obs["slot_mask"] or torch.equal(actor.distribution.mask, obs["slot_mask"])


def test_an_actor_is_rebuilt_from_its_architecture(actor, obs):
    twin = EagleActor.from_architecture(actor.architecture)
    twin.load_state_dict(actor.state_dict())
    assert torch.equal(twin(obs), actor(obs))


def test_a_history_that_is_not_whole_frames_is_refused(actor, obs):
    architecture = copy.deepcopy(actor.architecture)
    architecture["networks"]["history_length"] = 7
    with pytest.raises(ValueError, match="history of 7 equal frames"):
        EagleActor.from_architecture(architecture)


def test_the_last_layer_makes_the_mean_actions_of_the_hidden_activations(actor, obs):
    expected = actor(obs)
    torch.testing.assert_close(actor.mlp[-1](actor.hidden(obs)) * obs["slot_mask"], expected)


# --- two-sided ------------------------------------------------------------------------------------------------------


def two_sided(**algo) -> EagleActor:
    return make_runner(network=dataclasses.replace(NETWORK, symmetric=True), **algo).alg.actor


def mirrored(obs, mirror):
    seen = {group: obs[group][:, mirror[group][0]] * mirror[group][1] for group in ACTOR_INPUTS}
    perm, _ = mirror["actions"]
    return TensorDict(seen | {"slot_mask": obs["slot_mask"][:, perm]}, batch_size=obs.batch_size)


def test_a_two_sided_policy_does_in_the_mirror_exactly_what_it_does(obs):
    actor, mirror = two_sided(), ToyEnv().mirror
    perm, sign = mirror["actions"]
    everywhere = obs.clone()
    everywhere["slot_mask"] = torch.ones_like(obs["slot_mask"])
    actions = actor(everywhere)
    assert torch.equal(actor(mirrored(everywhere, mirror)), actions[:, perm] * sign)
    assert actions.abs().max() > 1e-3, "a policy that does nothing is symmetric and proves nothing"


def test_its_mean_is_that_of_its_networks_on_both_sides(obs):
    actor, mirror = two_sided(), ToyEnv().mirror
    alone = copy.deepcopy(actor).with_sides(None)
    perm, sign = mirror["actions"]
    here, there = alone(obs), alone(mirrored(obs, mirror))[:, perm] * sign
    assert not torch.allclose(here, there, atol=1e-3), "untrained networks know nothing of the mirror"
    torch.testing.assert_close(actor(obs), 0.5 * (here + there) * obs["slot_mask"])
    assert torch.equal(actor.embedding, alone.encoder(obs["history"]))


def test_both_sides_learn(obs):
    actor = two_sided()
    actor(obs).square().sum().backward()
    once = actor.mlp[-1].bias.grad.clone()
    perm, sign = ToyEnv().mirror["actions"]
    torch.testing.assert_close(once[perm] * sign, once, msg="a mean of both sides moves both sides alike")


def test_a_two_sided_policy_is_rebuilt_copied_and_exported_as_such(obs):
    actor = two_sided()
    with torch.device("meta"):  # as a checkpoint's is
        twin = EagleActor.from_architecture(actor.architecture)
    twin.load_state_dict(actor.state_dict(), assign=True)
    inputs = [obs[group] for group in (*ACTOR_INPUTS, "slot_mask")]
    for same in (twin, copy.deepcopy(actor)):
        assert torch.equal(same(obs), actor(obs))
    assert torch.equal(actor.as_onnx()(*inputs)[0], actor(obs))
    assert set(actor.state_dict()) == set(make_runner().alg.actor.state_dict()), "a mirror is no weight"


def test_another_last_layer_acts_on_both_sides(obs):
    actor = two_sided()
    inputs = [obs[group] for group in ACTOR_INPUTS]
    torch.testing.assert_close(actor.outputs(*inputs, actor.mlp[-1])[0], actor.outputs(*inputs)[0])
    nothing = actor.outputs(*inputs, lambda hidden: torch.zeros(len(hidden), 32))[0]
    assert not nothing.any()


def test_a_two_sided_policy_needs_no_mirror_loss():
    names = [type(term).__name__ for term in make_runner().alg.gradient.terms]
    assert "Mirror" in names
    symmetric = make_runner(network=dataclasses.replace(NETWORK, symmetric=True))
    assert [type(term).__name__ for term in symmetric.alg.gradient.terms] == [n for n in names if n != "Mirror"]
