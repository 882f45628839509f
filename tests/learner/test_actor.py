"""The policy as the rest of the project uses it."""

import copy

import pytest
import torch
from tensordict import TensorDict

from eagle_rl.models import EagleActor
from eagle_rl.models.actor import ACTOR_INPUTS
from tests.learner.helpers import make_runner
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
    latent = actor.get_latent(obs)
    newest = obs["history"][:, : obs["history"].shape[1] // FRAMES]
    assert torch.equal(latent, torch.cat([actor.embedding, actor.estimate, newest, obs["command"], obs["clock"]], 1))
    assert torch.equal(actor.embedding, actor.encoder(obs["history"]))
    assert torch.equal(actor.estimate, actor.estimator(actor.embedding))


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
